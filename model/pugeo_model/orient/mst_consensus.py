# SPDX-License-Identifier: Apache-2.0
"""Signs by two spanning trees, and a vote where they differ.

A tree hangs whole regions on one edge, and the lightest edge between the two faces of a wall may be
wrong where most are right. Which edge that is, small changes of the weights decide. So two trees
are grown, the second with weights changed by chance; the regions in which they agree with each
other are all that is doubtful, and what these are to each other all edges between them decide.

Before that come the edges that are sure, about half of all: no order of theirs changes much.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.orient.mst import Edges, spanning_tree_signs
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.tuning import TUNING

__all__ = ["join_by_consensus"]

_HEAVY = 0.1  # weight of an edge whose vote counts half


def join_by_consensus(forest: SignedUnionFind, edges: Edges) -> None:
    """Join the parts of a forest along edges, and let those be outvoted that are wrong.

    Args:
        forest: whose parts stay as they are within themselves.
        edges: between its nodes.
    """
    rows = forest.join_sure(
        edges.left, edges.right, edges.opposite, edges.weights, TUNING.sure_edges
    )
    if not len(rows):
        return
    # From here on the parts that are left are the nodes.
    turned, part = forest.read()
    left, right = edges.left[rows], edges.right[rows]
    opposite = edges.opposite[rows] ^ (turned[left] != turned[right])
    signs, groups = _by_votes(forest.parts, part[left], part[right], edges.weights[rows], opposite)
    lowest = forest.lowest()
    # The first node of each group has its sign.
    first = np.empty(groups.max() + 1, dtype=np.intp)
    first[groups[::-1]] = lowest[::-1]
    forest.join(first[groups], lowest, signs < 0)


def _by_votes(
    count: int,
    left: NDArray[np.intp],
    right: NDArray[np.intp],
    weights: NDArray[np.float32],
    opposite: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Arguments and answer as of `spanning_tree_signs`."""
    chance = np.random.default_rng(0).standard_exponential(len(weights), dtype=np.float32)
    signs, parts = spanning_tree_signs(count, left, right, weights, opposite)
    other, _ = spanning_tree_signs(count, left, right, weights * chance, opposite)
    differs = signs != other
    alike = np.flatnonzero(differs[left] == differs[right])
    agreed = SignedUnionFind(count)
    agreed.join(left, right, np.zeros_like(opposite), alike)
    region = agreed.read()[1]
    between = np.flatnonzero(region[left] != region[right])
    if not len(between):
        return signs, parts
    votes = 1.0 / (1.0 + weights[between] / _HEAVY)
    left, right = left[between], right[between]
    agree = np.where(opposite[between], -signs[left], signs[left]) * signs[right]
    pairs, value = _summed(region[left], region[right], agree * votes)
    weights = (1.0 / (1e-12 + np.abs(value))).astype(np.float32)
    turned, groups = spanning_tree_signs(int(region.max()) + 1, *pairs, weights, value < 0)
    return signs * turned[region], groups[region]


def _summed(
    left: NDArray[np.intp], right: NDArray[np.intp], votes: NDArray[np.float64]
) -> tuple[tuple[NDArray[Any], NDArray[Any]], NDArray[np.float64]]:
    """Each pair once, and the sum of its votes."""
    total = max(int(left.max()), int(right.max())) + 1
    keys = np.minimum(left, right) * total + np.maximum(left, right)
    pairs, which = np.unique(keys, return_inverse=True)
    summed = np.bincount(which, votes).astype(np.float64, copy=False)
    return (pairs // total, pairs % total), summed
