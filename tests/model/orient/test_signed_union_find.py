# SPDX-License-Identifier: Apache-2.0
"""Connected parts of nodes and relative signs within them."""

import numpy as np
import pytest

from pugeo_model.orient.signed_union_find import SignedUnionFind


def test_edges_between_nodes_of_one_kind():
    """Only the edges in ``order`` join parts; parts are numbered by their lowest rows."""
    ring, kind = np.arange(6), np.array([True, True, False, False, True, True])
    after = (ring + 1) % 6
    union_find = SignedUnionFind(6)
    union_find.join(ring, after, np.zeros(6, dtype=bool), np.flatnonzero(kind[ring] == kind[after]))
    assert union_find.read()[1].tolist() == [0, 0, 1, 1, 0, 0]
    assert union_find.parts == 2
    assert union_find.lowest().tolist() == [0, 2]


def test_the_first_edge_decides():
    """A later edge within a part changes nothing; an edge to a number outside is skipped."""
    left, right = np.array([0, 1, 0, 2]), np.array([1, 2, 2, 9])
    opposite = np.array([True, True, True, False])
    for order, signs in (([0, 1, 2, 3], [1, -1, 1]), ([2, 3, 1, 0], [1, 1, -1])):
        union_find = SignedUnionFind(3)
        union_find.join(left, right, opposite, np.array(order))
        assert union_find.read()[0].tolist() == signs
        assert union_find.parts == 1


@pytest.mark.parametrize("seed", range(5))
def test_signs_and_parts_are_those_of_the_graph(seed):
    """Parts joined in several calls along correct edges have the signs of the graph."""
    rng = np.random.default_rng(seed)
    home, sign = rng.integers(7, size=300), rng.choice([-1.0, 1.0], 300)
    left, right = rng.integers(300, size=(2, 20000)).astype(np.int32)
    inside = home[left] == home[right]
    left, right = left[inside], right[inside]
    opposite = sign[left] != sign[right]
    weights = rng.random(len(left)).astype(np.float32)
    union_find = SignedUnionFind(300)
    union_find.join(left[:50], right[:50], opposite[:50])
    between = union_find.join_sure(left, right, opposite, weights, (0.05, 0.15))
    _, parts = union_find.read()
    apart = parts[left] != parts[right]
    assert between.tolist() == np.flatnonzero(apart).tolist() != []
    assert (weights[between] > 0.15).all()
    union_find.join(left, right, opposite, between)
    signs, parts = union_find.read()
    assert union_find.parts == parts.max() + 1 == len(np.unique(home))
    for part in range(union_find.parts):
        mine = parts == part
        assert len(np.unique(home[mine])) == 1
        assert abs((signs * sign)[mine].sum()) == mine.sum()
        assert signs[np.flatnonzero(mine)[0]] == 1
