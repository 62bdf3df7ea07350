# SPDX-License-Identifier: Apache-2.0
"""The k nearest neighbours of every point, and the local spacing they give."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["NEIGHBOURS", "SPACING_NEIGHBOURS", "nearest", "spacing"]

NEIGHBOURS = 32
"""Neighbours that make up a chart's neighbourhood."""

SPACING_NEIGHBOURS = 8
"""Neighbours whose mean distance is the local spacing ``s``: on an even sample, one ring."""


def nearest(
    points: NDArray[np.float64], count: int = NEIGHBOURS, tree: cKDTree | None = None
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Nearest neighbours, the point itself left out.

    Args:
        points: ``(M, 3)`` float64, distinct.
        count: neighbours wanted. A cloud of fewer than ``count + 1`` points has its furthest
            neighbour repeated, so that the shape of the answer never depends on ``M``.
        tree: a kd-tree of ``points`` where the caller has one.

    Returns:
        Distances ``(M, count)`` float32 in the points' units and rows ``(M, count)`` int32,
        nearest first.
    """
    tree = tree or cKDTree(points)
    found = min(count + 1, len(points))
    distances, rows = tree.query(points, found)
    # Near-duplicates may come back before the point itself, so column 0 is not always "self".
    own = rows == np.arange(len(points))[:, None]
    missing = ~own.any(axis=1)
    own[missing, -1] = True
    distances = distances[~own].reshape(len(points), found - 1).astype(np.float32)
    rows = rows[~own].reshape(len(points), found - 1).astype(np.int32)
    if found - 1 < count:
        lack = ((0, 0), (0, count - found + 1))
        distances, rows = np.pad(distances, lack, mode="edge"), np.pad(rows, lack, mode="edge")
    return distances, rows


def spacing(distances: NDArray[np.float32]) -> NDArray[np.float32]:
    """Local spacing ``s``: mean distance to the 8 nearest, ``(M, k)`` -> ``(M,)``, units kept."""
    near = distances[:, :SPACING_NEIGHBOURS]
    return np.maximum(near.mean(axis=1), np.finfo(np.float32).tiny)
