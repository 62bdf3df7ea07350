# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.resample.seams import BorderPoints, separate

NORMAL = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def halves():
    """Two halves of a triangular lattice of spacing 1, as border points of two tiles."""
    rows, columns = np.meshgrid(np.arange(20), np.arange(20))
    x = columns + 0.5 * (rows % 2)
    points = np.stack([x, rows * np.sqrt(0.75), 0 * x], axis=-1).reshape(-1, 3)
    left = points[:, 0] < 9.9
    return [points[left], points[~left]]


def border(points, fixed=(), room=np.inf):
    """Border points with radius 1 that may move by ``room``; those in ``fixed`` are not moved."""
    radius = np.ones(len(points))
    radius[list(fixed)] = 0.0
    normals = np.broadcast_to(NORMAL, points.shape).astype(np.float32)
    outermost = np.ones(len(points), dtype=np.bool_)
    rows = np.arange(len(points), dtype=np.int32)
    return BorderPoints(rows, points, normals, radius, outermost, np.full(len(points), room))


def closest(points):
    return float(np.ravel(cKDTree(points).query(points, k=[2])[0]).min())


def test_even_borders_are_unchanged(halves):
    """Points that are not too close are unchanged, bit for bit."""
    for before, after in zip(halves, separate([border(half) for half in halves]), strict=True):
        assert before.tobytes() == after.tobytes()


def test_nearly_coincident_points_are_separated(halves):
    """They and the points around them move within the plane; distant points do not."""
    left, right = halves
    point = right[np.argmin(np.linalg.norm(right - [10.0, 9.0, 0.0], axis=1))] + [0.02, 0.01, 0.0]
    left = np.append(left, [point], axis=0)
    assert closest(np.concatenate([left, right])) < 0.03
    moved = separate([border(left), border(right)])
    assert [len(each) for each in moved] == [len(left), len(right)]
    together = np.concatenate(moved)
    assert closest(together) > 0.5
    assert np.abs(together[:, 2]).max() == 0.0
    far = np.linalg.norm(left - point, axis=1) > 2.0
    np.testing.assert_array_equal(moved[0][far], left[far])


def test_no_point_moves_beyond_its_room(halves):
    """Points are pushed apart, but by no more than keeps them near the input."""
    left, right = halves
    point = right[np.argmin(np.linalg.norm(right - [10.0, 9.0, 0.0], axis=1))] + [0.02, 0.01, 0.0]
    left = np.append(left, [point], axis=0)
    moved = separate([border(left, room=0.1), border(right, room=0.0)])
    np.testing.assert_array_equal(moved[1], right)
    steps = np.linalg.norm(moved[0] - left, axis=1)
    np.testing.assert_allclose(steps.max(), 0.1)


def test_kept_input_points_are_fixed(halves):
    """A kept input point does not move, the other point does."""
    left, right = halves
    at = int(np.argmin(np.linalg.norm(right - [10.0, 9.0, 0.0], axis=1)))
    left = np.append(left, [right[at] + [0.02, 0.01, 0.0]], axis=0)
    moved = separate([border(left), border(right, fixed=[at])])
    np.testing.assert_array_equal(moved[1][at], right[at])
    assert np.linalg.norm(moved[0][-1] - right[at]) > 0.4


def test_close_points_of_one_tile_are_unchanged(halves):
    """Only points of different tiles are separated."""
    left, right = halves
    left = np.append(left, left[:1] + [0.1, 0.0, 0.0], axis=0)
    moved = separate([border(left), border(right)])
    np.testing.assert_array_equal(moved[0], left)


def test_tiles_without_points_along_their_borders():
    """Tiles with no or one border point are unchanged."""
    assert [
        len(each) for each in separate([border(np.empty((0, 3))), border(np.zeros((1, 3)))])
    ] == [
        0,
        1,
    ]
