# SPDX-License-Identifier: Apache-2.0
"""Wild values and no-data values are found, sparse parts of a scan are not."""

import numpy as np
import pytest

from pugeo_model.outliers import wild_points


def _cloud(count: int = 2000) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.0, 1.0, (count, 3))


@pytest.mark.parametrize("value", [1e7, -1e7, 1e12, 1.7e308, -1.7e308])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_wild_value_is_found(value: float, axis: int) -> None:
    """One value far away is wild, whatever its size and axis, and no other point is."""
    points = _cloud()
    points[7, axis] = value
    assert np.flatnonzero(wild_points(points)).tolist() == [7]


def test_eight_wild_values_on_both_sides_are_found() -> None:
    """Several wild points are found although they are far from each other too."""
    points = _cloud()
    points[:8] = np.array([1e12, -1e12]).repeat(4)[:, None] * np.arange(1, 9)[:, None]
    assert np.flatnonzero(wild_points(points)).tolist() == list(range(8))


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 3.4028234663852886e38])
def test_many_points_with_a_no_data_value_are_found(value: float) -> None:
    """A third of the points may have the no-data value of a raster."""
    points = _cloud() * 100.0
    points[::3, 2] = value
    assert np.array_equal(np.flatnonzero(wild_points(points)), np.arange(0, 2000, 3))


def test_a_point_off_a_flat_plate_stays() -> None:
    """Extents count over all axes: one point above an exact plane is a detail."""
    points = _cloud() * [100.0, 100.0, 0.0]
    points[3, 2] = 1.0
    assert not wild_points(points).any()


def test_sparse_parts_of_a_scan_stay() -> None:
    """Distances that grow by a factor from point to point are no gap: a scanner sees far."""
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * np.exp(rng.uniform(0.0, np.log(1e4), (4000, 1)))
    assert not wild_points(points).any()


@pytest.mark.parametrize("count", [1, 2, 8, 9])
def test_few_points_are_no_outliers(count: int) -> None:
    """Something must be left: of a handful of points none is wild."""
    points = _cloud(count)
    assert not wild_points(points).any()
