# SPDX-License-Identifier: Apache-2.0
"""Signs by two spanning trees, and a vote where they differ.

A tree hangs whole regions on one edge, and the lightest edge between the two faces of a wall may be
wrong where most are right. Which edge that is, small changes of the weights decide. So two trees
are grown, the second with weights changed by chance; the regions in which they agree with each
other are all that is doubtful, and what these are to each other all edges between them decide.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.finish.spanning import Edges, by_weight, join, join_in_order, regions

__all__ = ["join_by_votes"]

_HEAVY = 0.1  # weight of an edge whose vote counts half
_LESS = 1e-4  # share of a vote that one of the next kind has: as good as none beside the first


def join_by_votes(
    count: int, kinds: Sequence[Edges]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Signs of nodes along edges, the first kind of edges before the second, and so on.

    Args:
        count: number of nodes.
        kinds: edges between them; at least one.

    Returns:
        As `join`: signs -1 or 1 ``(count,)``, consistent within each connected part, and the part
        ``(count,)`` of each node, numbered from 0.
    """
    left, right, opposite = (
        np.concatenate([getattr(edges, name) for edges in kinds])
        for name in ("left", "right", "opposite")
    )
    rng = np.random.default_rng(0)
    plain = [edges.weights for edges in kinds]
    changed = [
        weights * rng.standard_exponential(len(weights), dtype=np.float32) for weights in plain
    ]
    signs, parts = join_in_order(count, left, right, opposite, by_weight(plain))
    other, _ = join_in_order(count, left, right, opposite, by_weight(changed))
    differs = signs != other
    region = regions(left, right, differs)
    between = np.flatnonzero(region[left] != region[right])
    if not len(between):
        return signs, parts
    votes = np.concatenate(
        [_LESS**rank / (1.0 + weights / _HEAVY) for rank, weights in enumerate(plain)]
    )
    left, right = left[between], right[between]
    agree = np.where(opposite[between], -signs[left], signs[left]) * signs[right]
    pairs, value = _summed(region[left], region[right], agree * votes[between])
    weights = (1.0 / (1e-12 + np.abs(value))).astype(np.float32)
    turned, groups = join(int(region.max()) + 1, *pairs, weights, value < 0)
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
