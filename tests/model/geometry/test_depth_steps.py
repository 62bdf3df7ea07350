# SPDX-License-Identifier: Apache-2.0
"""Depth steps: the axis along which a camera rounds, and what is only a raster."""

import numpy as np
import pytest

from pugeo_model.geometry.depth_steps import DepthSteps, find_depth_steps
from pugeo_model.geometry.neighbours import nearest
from pugeo_model.geometry.quadric_at_points import quadrics_at
from pugeo_model.geometry.regions import nested_regions


def _found(points: np.ndarray) -> DepthSteps | None:
    unit = points / np.ptp(points, axis=0).max()
    distances, neighbours = nearest(unit)
    near = quadrics_at(np.arange(len(unit)), unit, neighbours, distances)
    return find_depth_steps(unit, near, nested_regions(unit))


def _raster(height: np.ndarray) -> np.ndarray:
    rows, columns = height.shape
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows) * 1.3)
    return np.stack([x, y, height], -1).reshape(-1, 3)


def _slope() -> np.ndarray:
    y, x = np.mgrid[:50, :60]
    return np.asarray(0.21 * x + 0.13 * y)


def test_the_axis_and_the_step() -> None:
    """Heights of a slope that are rounded to one unit."""
    found = _found(_raster(np.round(_slope())))
    assert found is not None
    np.testing.assert_array_equal(found.axis, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(found.step, 1.0 / 63.7, rtol=1e-6)


def test_steps_that_grow() -> None:
    """Each point has the step at its own depth, as with disparity."""
    depth = 1000.0 / np.round(1000.0 / (_slope() + 30.0))
    found = _found(_raster(depth))
    assert found is not None
    near, far = found.step[depth.ravel() < 32], found.step[depth.ravel() > 44]
    assert far.mean() > 1.7 * near.mean()


@pytest.mark.parametrize("kind", ["raster", "voxels", "small", "lines", "box", "random"])
def test_no_steps(kind: str) -> None:
    """Places of a raster or of scan lines, voxels, steps too small to matter, faces of a box."""
    rng = np.random.default_rng(0)
    points = _raster(_slope())
    if kind == "voxels":
        points = np.unique(np.round(rng.normal(size=(20_000, 3)) * [9.0, 9.0, 3.0]), axis=0)
    elif kind == "small":
        points = _raster(np.round(_slope(), 2))
    elif kind == "lines":
        points[:, 1] += rng.uniform(-0.3, 0.3, len(points))
    elif kind == "box":
        points = rng.uniform(0.0, 1.0, (6000, 3))
        points[np.arange(6000), np.arange(6000) % 3] = rng.integers(0, 2, 6000)
    elif kind == "random":
        points = rng.normal(size=(3000, 3))
    assert _found(points) is None
