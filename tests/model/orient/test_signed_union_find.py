# SPDX-License-Identifier: Apache-2.0
"""Parts of nodes, and signs within them."""

import numpy as np
import pytest

from pugeo_model.orient.signed_union_find import SignedUnionFind


def test_edges_between_nodes_of_one_kind():
    """Only the edges asked for join; parts are numbered by their lowest rows."""
    ring, kind = np.arange(6), np.array([True, True, False, False, True, True])
    after = (ring + 1) % 6
    forest = SignedUnionFind(6)
    forest.join(ring, after, np.zeros(6, dtype=bool), np.flatnonzero(kind[ring] == kind[after]))
    assert forest.read()[1].tolist() == [0, 0, 1, 1, 0, 0]
    assert forest.parts == 2
    assert forest.lowest().tolist() == [0, 2]


def test_the_first_edge_decides():
    """One that comes later, within a part, changes nothing; one that leads nowhere is skipped."""
    left, right = np.array([0, 1, 0, 2]), np.array([1, 2, 2, 9])
    opposite = np.array([True, True, True, False])
    for order, signs in (([0, 1, 2, 3], [1, -1, 1]), ([2, 3, 1, 0], [1, 1, -1])):
        forest = SignedUnionFind(3)
        forest.join(left, right, opposite, np.array(order))
        assert forest.read()[0].tolist() == signs
        assert forest.parts == 1


@pytest.mark.parametrize("seed", range(5))
def test_signs_and_parts_are_those_of_the_graph(seed):
    """A forest joined in several goes, by edges that tell the truth, knows all of it."""
    rng = np.random.default_rng(seed)
    home, sign = rng.integers(7, size=300), rng.choice([-1.0, 1.0], 300)
    left, right = rng.integers(300, size=(2, 20000)).astype(np.int32)
    inside = home[left] == home[right]
    left, right = left[inside], right[inside]
    opposite = sign[left] != sign[right]
    weights = rng.random(len(left)).astype(np.float32)
    forest = SignedUnionFind(300)
    forest.join(left[:50], right[:50], opposite[:50])
    between = forest.join_sure(left, right, opposite, weights, (0.05, 0.15))
    _, parts = forest.read()
    apart = parts[left] != parts[right]
    assert between.tolist() == np.flatnonzero(apart).tolist() != []
    assert (weights[between] > 0.15).all()
    forest.join(left, right, opposite, between)
    signs, parts = forest.read()
    assert forest.parts == parts.max() + 1 == len(np.unique(home))
    for part in range(forest.parts):
        mine = parts == part
        assert len(np.unique(home[mine])) == 1
        assert abs((signs * sign)[mine].sum()) == mine.sum()
        assert signs[np.flatnonzero(mine)[0]] == 1
