# SPDX-License-Identifier: Apache-2.0
"""Axis-aligned bounding boxes."""

import numpy as np

from pugeo_model.geometry.aabb import bounds, rows_inside


def test_corners_and_inside() -> None:
    """Results equal those of numpy; the border belongs to the box, and rows keep their order."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    rows = rng.permutation(500)[:200].astype(np.int32)
    low, high = bounds(points, rows)
    assert np.array_equal(low, points[rows].min(axis=0))
    assert np.array_equal(high, points[rows].max(axis=0))
    assert np.array_equal(rows_inside(points, rows, low, high), rows)
    found = rows_inside(points, rows, np.zeros(3), high)
    assert np.array_equal(found, rows[(points[rows] >= 0).all(axis=1)])
    assert 0 < len(found) < 60
    assert not len(rows_inside(points, rows, high + 1, high + 2))
