# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.knn import nearest_by_leaves
from pugeo_model.geometry.neighbours import nearest

RNG = np.random.default_rng(0)
CLOUDS = {
    "surface": RNG.random((5000, 3)) * [1.0, 1.0, 0.01],
    "volume": RNG.random((5000, 3)),
    "line": RNG.random((2000, 3)) * [1.0, 1e-4, 1e-4],
    "no more than a leaf": RNG.random((33, 3)),
    "clusters": np.concatenate([RNG.normal(0, 1e-4, (4000, 3)), RNG.random((500, 3))]),
    "nearly one point": np.concatenate([RNG.random((50, 3)) * 1e-200, RNG.random((200, 3))]),
}


@pytest.mark.parametrize("cloud", CLOUDS.values(), ids=CLOUDS)
def test_the_tree_finds_the_same(cloud: np.ndarray) -> None:
    """Distances equal those of a k-d tree, and the rows have these distances."""
    expected = cKDTree(cloud).query(cloud, np.arange(1, 34))[0]
    distances, rows = nearest(cloud)
    np.testing.assert_array_equal(distances, np.asarray(expected, np.float32)[:, 1:])
    distance = np.linalg.norm(cloud[rows] - cloud[:, None], axis=2)
    np.testing.assert_allclose(distance, distances, rtol=1e-6, atol=1e-12)
    assert not (rows == np.arange(len(cloud))[:, None]).any()
    assert (np.diff(np.sort(rows, axis=1)) > 0).all()


def test_equals_come_in_their_order() -> None:
    """On a lattice with many equal distances, lower rows come first."""
    axes = np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij")
    lattice = np.stack(axes, axis=-1).reshape(-1, 3)
    distances, rows = nearest_by_leaves(lattice, 32)
    same = distances[:, 1:] == distances[:, :-1]
    assert (rows[:, 1:] > rows[:, :-1])[same].all()


def test_too_many_points_around_a_leaf() -> None:
    """Points with thousands of others around their leaf are marked and left to the caller."""
    dense = RNG.normal(0, 1e-4, (20_000, 3))
    _, rows = nearest_by_leaves(np.concatenate([dense, RNG.random((40, 3))]), 32)
    missing = rows[:, 0] < 0
    assert missing[20_000:].any()
    assert (rows[missing] == -1).all()
    assert not missing.all()
