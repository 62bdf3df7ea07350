# SPDX-License-Identifier: Apache-2.0
"""Relative signs from two spanning trees, with a vote where they differ.

In a spanning tree one edge decides the sign of a whole region, and the lightest edge between the
two faces of a wall may be wrong although most are right. Two trees are therefore built, the second
one with randomly changed weights. Regions within which both trees agree keep their signs, and all
edges between two regions vote on their relative sign.

About half of the edges are reliable and are joined before, in any order, which saves time.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.orient.mst import Edges, spanning_tree_signs
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.tuning import TUNING

__all__ = ["join_by_consensus"]


def join_by_consensus(union_find: SignedUnionFind, edges: Edges) -> None:
    """Join parts along edges; edges that contradict the majority are ignored.

    Args:
        union_find: parts; the relative signs within each are not changed.
        edges: edges between its nodes.
    """
    rows = union_find.join_sure(
        edges.left, edges.right, edges.opposite, edges.weights, TUNING.sure_edges
    )
    if not len(rows):
        return
    # From here on the remaining parts are the nodes.
    node_signs, part = union_find.read()
    left, right = edges.left[rows], edges.right[rows]
    opposite = edges.opposite[rows] ^ (node_signs[left] != node_signs[right])
    weights = edges.weights[rows]
    signs, groups = _by_votes(union_find.parts, part[left], part[right], weights, opposite)
    lowest = union_find.lowest()
    # The first part of each group has the sign of the group.
    first = np.empty(groups.max() + 1, dtype=np.intp)
    first[groups[::-1]] = lowest[::-1]
    union_find.join(first[groups], lowest, signs < 0)


def _by_votes(
    count: int,
    left: NDArray[np.intp],
    right: NDArray[np.intp],
    weights: NDArray[np.float32],
    opposite: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Signs and connected parts by two trees and a vote; arguments as `spanning_tree_signs`."""
    factors = np.random.default_rng(0).standard_exponential(len(weights), dtype=np.float32)
    signs, parts = spanning_tree_signs(count, left, right, weights, opposite)
    other, _ = spanning_tree_signs(count, left, right, weights * factors, opposite)
    differs = signs != other
    consistent = np.flatnonzero(differs[left] == differs[right])
    regions = SignedUnionFind(count)
    regions.join(left, right, np.zeros_like(opposite), consistent)
    region = regions.read()[1]
    between = np.flatnonzero(region[left] != region[right])
    if not len(between):
        return signs, parts
    votes = 1.0 / (1.0 + weights[between] / TUNING.half_vote)
    left, right = left[between], right[between]
    agreement = np.where(opposite[between], -signs[left], signs[left]) * signs[right]
    pairs, total = _sum_by_pair(region[left], region[right], agreement * votes)
    weights = (1.0 / (1e-12 + np.abs(total))).astype(np.float32)
    region_signs, groups = spanning_tree_signs(int(region.max()) + 1, *pairs, weights, total < 0)
    return signs * region_signs[region], groups[region]


def _sum_by_pair(
    left: NDArray[np.intp], right: NDArray[np.intp], votes: NDArray[np.float64]
) -> tuple[tuple[NDArray[Any], NDArray[Any]], NDArray[np.float64]]:
    """Distinct pairs (in any order of their ends) and the sum of the votes of each."""
    total = max(int(left.max()), int(right.max())) + 1
    keys = np.minimum(left, right) * total + np.maximum(left, right)
    pairs, which = np.unique(keys, return_inverse=True)
    summed = np.bincount(which, votes).astype(np.float64, copy=False)
    return (pairs // total, pairs % total), summed
