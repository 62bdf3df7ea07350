# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.resample.elimination import eliminate, packing_radius
from pugeo_model.resample.repulsion import repel

REACH = 0.5


def settled(samples, normals, lists, rounds=1, radius=None):
    radius = np.full(len(samples), REACH) if radius is None else radius
    return repel(
        np.array(samples, dtype=np.float64),
        np.array(normals, dtype=np.float32),
        np.array(lists, dtype=np.int32),
        radius,
        rounds,
    )


def test_samples_part_within_their_plane():
    """Two of a plane move apart by as much, along the line between them and not off the plane."""
    after = settled([[0, 0, 0], [0.3, 0, 0]], [[0, 0, 1]] * 2, [[1, -1], [0, -1]])
    assert after[0, 0] < 0.0
    assert after[1, 0] > 0.3
    np.testing.assert_allclose(after.mean(axis=0), [0.15, 0, 0])
    np.testing.assert_array_equal(after[:, 1:], 0.0)


def test_samples_across_a_crease_part_too():
    """Of two faces at a right angle each keeps its samples from being pushed over the edge."""
    # On the floor and on the wall, each 0.1 from the edge along the y axis.
    after = settled([[0.1, 0, 0], [0, 0, 0.1]], [[0, 0, 1], [1, 0, 0]], [[1, -1], [0, -1]])
    assert after[0, 0] > 0.1
    assert after[1, 2] > 0.1
    assert after[0, 2] == after[1, 0] == 0.0


def test_what_is_far_and_what_is_held():
    """Beyond 1.3 radii nobody pushes; whose radius is zero pushes and stays."""
    row = [[0, 0, 0], [0.3, 0, 0], [2, 0, 0]]
    after = settled(
        row, [[0, 0, 1]] * 3, [[1, 2], [0, 2], [1, -1]], 3, np.array([0.0, REACH, REACH])
    )
    np.testing.assert_array_equal(after[[0, 2]], np.array(row, dtype=np.float64)[[0, 2]])
    assert after[1, 0] > 0.3


def test_no_round_moves_far():
    """A quarter of the radius at most, however close samples are."""
    samples = np.random.default_rng(0).normal(size=(6, 3), scale=1e-3)
    samples[:, 2] = 0.0
    lists = [[other for other in range(6) if other != row] for row in range(6)]
    after = settled(samples, [[0, 0, 1]] * 6, lists)
    assert np.linalg.norm(after - samples, axis=1).max() <= 0.25 * REACH * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_do_not_hold_a_pair_together(seed):
    """Of few candidates some survivors lie on each other; the push of a pair is the stronger."""
    rng = np.random.default_rng(seed)
    candidates = np.append(rng.random((4500, 2)), np.zeros((4500, 1)), axis=1)
    radius = np.full(4500, packing_radius(np.array(1 / 3000)))
    kept = eliminate(candidates, _within(candidates, radius[0]), radius, 3000)
    samples, radius = candidates[kept], radius[:3000]
    after = settled(samples, [[0, 0, 1]] * 3000, _within(samples, 1.4 * radius[0]), 6, radius)
    inside = np.abs(after[:, :2] - 0.5).max(axis=1) < 0.45
    distance = knn(cKDTree(after), after, 2)[0][inside, 1]
    # 0.215 to 0.219, and 0.12 to 0.13, with a push that only falls with the distance.
    assert distance.min() > 0.26 * radius[0]
    assert distance.std() / distance.mean() < 0.12


def _within(points, radius):
    distance, rows = knn(cKDTree(points), points, 16, radius)
    return np.where(np.isfinite(distance), rows, -1)[:, 1:].astype(np.int32)
