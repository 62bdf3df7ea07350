# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.resample.elimination import eliminate, packing_radius
from pugeo_model.resample.repulsion import repel

RADIUS = 0.5


def repelled(samples, normals, lists, rounds=1, radius=None):
    """Repel samples given as lists."""
    radius = np.full(len(samples), RADIUS) if radius is None else radius
    return repel(
        np.array(samples, dtype=np.float64),
        np.array(normals, dtype=np.float32),
        np.array(lists, dtype=np.int32),
        radius,
        rounds,
    )


def test_two_samples_of_a_plane():
    """They move apart by the same distance along their connecting line, within the plane."""
    after = repelled([[0, 0, 0], [0.3, 0, 0]], [[0, 0, 1]] * 2, [[1, -1], [0, -1]])
    assert after[0, 0] < 0.0
    assert after[1, 0] > 0.3
    np.testing.assert_allclose(after.mean(axis=0), [0.15, 0, 0])
    np.testing.assert_array_equal(after[:, 1:], 0.0)


def test_samples_across_a_crease():
    """Samples of two faces at a right angle push each other away from the edge."""
    # One on each face, 0.1 from the edge along the y axis.
    after = repelled([[0.1, 0, 0], [0, 0, 0.1]], [[0, 0, 1], [1, 0, 0]], [[1, -1], [0, -1]])
    assert after[0, 0] > 0.1
    assert after[1, 2] > 0.1
    assert after[0, 2] == after[1, 0] == 0.0


def test_distant_and_fixed_samples():
    """Beyond 1.3 radii there is no push; a sample with radius 0 pushes but does not move."""
    row = [[0, 0, 0], [0.3, 0, 0], [2, 0, 0]]
    after = repelled(
        row, [[0, 0, 1]] * 3, [[1, 2], [0, 2], [1, -1]], 3, np.array([0.0, RADIUS, RADIUS])
    )
    np.testing.assert_array_equal(after[[0, 2]], np.array(row, dtype=np.float64)[[0, 2]])
    assert after[1, 0] > 0.3


def test_moves_are_bounded():
    """A sample moves by at most a quarter of the radius in a round."""
    samples = np.random.default_rng(0).normal(size=(6, 3), scale=1e-3)
    samples[:, 2] = 0.0
    lists = [[other for other in range(6) if other != row] for row in range(6)]
    after = repelled(samples, [[0, 0, 1]] * 6, lists)
    assert np.linalg.norm(after - samples, axis=1).max() <= 0.25 * RADIUS * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_do_not_hold_a_pair_together(seed):
    """Nearly coincident survivors of few candidates are separated."""
    rng = np.random.default_rng(seed)
    candidates = np.append(rng.random((4500, 2)), np.zeros((4500, 1)), axis=1)
    radius = np.full(4500, packing_radius(np.array(1 / 3000)))
    kept = eliminate(candidates, _within(candidates, radius[0]), radius, 3000)
    samples, radius = candidates[kept], radius[:3000]
    after = repelled(samples, [[0, 0, 1]] * 3000, _within(samples, 1.4 * radius[0]), 6, radius)
    inside = np.abs(after[:, :2] - 0.5).max(axis=1) < 0.45
    distance = knn(cKDTree(after), after, 2)[0][inside, 1]
    # Without the increase at small distances: 0.215 to 0.219, and 0.12 to 0.13.
    assert distance.min() > 0.26 * radius[0]
    assert distance.std() / distance.mean() < 0.12


def _within(points, radius):
    distance, rows = knn(cKDTree(points), points, 16, radius)
    return np.where(np.isfinite(distance), rows, -1)[:, 1:].astype(np.int32)
