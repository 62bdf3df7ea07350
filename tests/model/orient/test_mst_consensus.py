# SPDX-License-Identifier: Apache-2.0
"""Relative signs from two spanning trees and a vote."""

import numpy as np
import pytest

from pugeo_model.orient.mst import Edges, spanning_tree_signs
from pugeo_model.orient.mst_consensus import join_by_consensus
from pugeo_model.orient.signed_union_find import SignedUnionFind


def voted(count: int, kinds: list[Edges]):
    """Signs and parts of nodes, joined by several sets of edges in turn."""
    union_find = SignedUnionFind(count)
    for kind in kinds:
        join_by_consensus(union_find, kind)
    signs, parts = union_find.read()
    assert union_find.parts == parts.max() + 1
    return signs, parts


def edges(*rows: tuple[int, int, float, bool]) -> Edges:
    """Edges from ends, weight, and whether the signs of the ends differ."""
    left, right, weights, opposite = zip(*rows, strict=True)
    return Edges(
        np.array(left, dtype=np.int32),
        np.array(right, dtype=np.int32),
        np.array(weights, dtype=np.float32),
        np.array(opposite),
    )


def bars(wrong: float, right: float = 0.03) -> Edges:
    """Two rows of ten nodes, each consistent, and ten edges between, of which the first differs."""
    inside = [(row + i, row + i + 1, 0.001, False) for row in (0, 10) for i in range(9)]
    between = [(i, 10 + i, wrong if i == 0 else right, i == 0) for i in range(10)]
    return edges(*inside, *between)


def test_many_outvote_one():
    """A single tree follows the lightest edge between two regions; the vote follows the others."""
    both = bars(0.02)
    plain, _ = spanning_tree_signs(20, both.left, both.right, both.weights, both.opposite)
    assert (plain[:10] == 1).all()
    assert (plain[10:] == -1).all()
    signs, parts = voted(20, [both])
    assert (signs == 1).all()
    assert (parts == 0).all()


def test_where_both_trees_agree_nothing_changes():
    """An edge that is much lighter than all others decides alone."""
    both = bars(0.0101, 1.9)
    signs, _ = voted(20, [both])
    assert (signs[10:] == -signs[0]).all()


@pytest.mark.parametrize("opposite", [False, True])
def test_the_next_kind_only_joins_what_is_apart(opposite: bool):
    """Light edges of a later set do not change signs within a part."""
    first = edges((0, 1, 1.9, opposite))
    second = edges((0, 1, 0.0, not opposite), (1, 2, 0.5, False))
    signs, parts = voted(4, [first, second])
    other = -1 if opposite else 1
    assert signs[:3].tolist() == [1, other, other]
    assert parts.tolist() == [0, 0, 0, 1]


def test_each_kind_goes_by_its_own_weights():
    """Of two contradicting edges the lighter one decides, also in the last set."""
    none = edges((3, 3, 0.0, False))
    last = edges((0, 1, 0.3, True), (0, 1, 0.02, False))
    signs, _ = voted(4, [none, none, last])
    assert signs.tolist() == [1, 1, 1, 1]


def test_parts_stay_as_they_are():
    """A later set flips existing parts as a whole or not at all."""
    first = edges((0, 1, 0.5, True), (2, 3, 0.5, False))
    signs, parts = voted(4, [first, edges((1, 2, 0.5, True), (0, 2, 0.4, False))])
    assert signs.tolist() == [1, -1, 1, 1]
    assert (parts == 0).all()


def test_sure_edges_and_others_come_to_one_verdict():
    """For a graph without contradictions the signs are exact, for any weights."""
    rng = np.random.default_rng(3)
    true = rng.choice([-1.0, 1.0], 400)
    ends = rng.integers(400, size=(2, 2000))
    weights = rng.choice([0.0, 0.001, 0.01, 0.2, 1.0], 2000)
    opposite = true[ends[0]] != true[ends[1]]
    signs, parts = voted(400, [edges(*zip(*ends.tolist(), weights, opposite, strict=True))])
    for part in range(parts.max() + 1):
        inside = parts == part
        assert abs((signs * true)[inside].sum()) == inside.sum()


def test_sure_edges_go_level_by_level():
    """Of two contradicting reliable edges the lighter one counts, in any order; NaN never does."""
    for order in ([0, 1], [1, 0]):
        two = [(0, 1, 0.008, True), (0, 1, 0.001, False)]
        signs, _ = voted(2, [edges(*(two[i] for i in order))])
        assert signs.tolist() == [1, 1]
    signs, _ = voted(2, [edges((0, 1, np.nan, True), (0, 1, 0.001, False))])
    assert signs.tolist() == [1, 1]
