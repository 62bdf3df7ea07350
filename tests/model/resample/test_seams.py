# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.resample.seams import BorderPoints, separate

NORMAL = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def halves():
    """Two halves of a triangular lattice of spacing 1, as two tiles' rims."""
    rows, columns = np.meshgrid(np.arange(20), np.arange(20))
    x = columns + 0.5 * (rows % 2)
    points = np.stack([x, rows * np.sqrt(0.75), 0 * x], axis=-1).reshape(-1, 3)
    left = points[:, 0] < 9.9
    return [points[left], points[~left]]


def rim(points, stays=()):
    radius = np.ones(len(points))
    radius[list(stays)] = 0.0
    normals = np.broadcast_to(NORMAL, points.shape).astype(np.float32)
    outermost = np.ones(len(points), dtype=np.bool_)
    return BorderPoints(np.arange(len(points), dtype=np.int32), points, normals, radius, outermost)


def closest(points):
    return float(np.ravel(cKDTree(points).query(points, k=[2])[0]).min())


def test_what_is_even_stays_as_it_is(halves):
    """To the last bit, as most borders are."""
    for before, after in zip(halves, separate([rim(half) for half in halves]), strict=True):
        assert before.tobytes() == after.tobytes()


def test_two_on_one_spot_are_parted(halves):
    """They and those around make room, within the plane; far from them nothing moves."""
    left, right = halves
    spot = right[np.argmin(np.linalg.norm(right - [10.0, 9.0, 0.0], axis=1))] + [0.02, 0.01, 0.0]
    left = np.append(left, [spot], axis=0)
    assert closest(np.concatenate([left, right])) < 0.03
    moved = separate([rim(left), rim(right)])
    assert [len(each) for each in moved] == [len(left), len(right)]
    together = np.concatenate(moved)
    assert closest(together) > 0.5
    assert np.abs(together[:, 2]).max() == 0.0
    far = np.linalg.norm(left - spot, axis=1) > 2.0
    np.testing.assert_array_equal(moved[0][far], left[far])


def test_points_of_the_input_stay(halves):
    """One that is kept makes no room: the other goes."""
    left, right = halves
    at = int(np.argmin(np.linalg.norm(right - [10.0, 9.0, 0.0], axis=1)))
    left = np.append(left, [right[at] + [0.02, 0.01, 0.0]], axis=0)
    moved = separate([rim(left), rim(right, stays=[at])])
    np.testing.assert_array_equal(moved[1][at], right[at])
    assert np.linalg.norm(moved[0][-1] - right[at]) > 0.4


def test_points_of_one_tile_are_its_own_business(halves):
    """However close they are: the merge has had its say on them."""
    left, right = halves
    left = np.append(left, left[:1] + [0.1, 0.0, 0.0], axis=0)
    moved = separate([rim(left), rim(right)])
    np.testing.assert_array_equal(moved[0], left)


def test_tiles_without_points_along_their_borders():
    """Parts of a cloud that do not touch have nothing to agree on."""
    assert [len(each) for each in separate([rim(np.empty((0, 3))), rim(np.zeros((1, 3)))])] == [
        0,
        1,
    ]
