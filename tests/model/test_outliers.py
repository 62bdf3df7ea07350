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


@pytest.mark.parametrize("value", [-999.0, -9999.0, -3.4028234663852886e38])
@pytest.mark.parametrize("share", [0.1, 0.55, 0.9])
def test_most_points_may_have_a_value_that_rasters_use(value: float, share: float) -> None:
    """A raster may have more cells without data than with."""
    points = _cloud() * 100.0
    empty = np.random.default_rng(1).random(len(points)) < share
    points[empty, 2] = value
    assert np.array_equal(wild_points(points), empty)


def test_two_no_data_values_are_found() -> None:
    """Both are left out, whichever is farther away."""
    points = _cloud() * 100.0
    points[:400, 2], points[400:800, 2] = -9999.0, 3e38
    assert np.array_equal(np.flatnonzero(wild_points(points)), np.arange(800))


def test_planes_at_common_heights_stay() -> None:
    """Two exact levels are no no-data values if neither is one that rasters use."""
    points = _cloud() * 100.0
    points[:700, 2] = 1000.0
    assert not wild_points(points).any()


@pytest.mark.parametrize(("count", "wild"), [(2000, 20), (60, 1), (30, 1), (100, 9)])
def test_a_group_of_wild_points_is_found(count: int, wild: int) -> None:
    """Points that were moved together are wild, in small clouds too."""
    points = _cloud(count)
    points[:wild] += 1e7
    assert np.array_equal(np.flatnonzero(wild_points(points)), np.arange(wild))


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
