# SPDX-License-Identifier: Apache-2.0
"""The k nearest neighbours of every point, and the local spacing they give."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.knn import nearest_by_leaves

__all__ = ["NEIGHBOURS", "SPACING_NEIGHBOURS", "knn", "nearest", "spacing"]

NEIGHBOURS = 32
"""Neighbours that make up a chart's neighbourhood."""

SPACING_NEIGHBOURS = 8
"""Neighbours whose mean distance is the local spacing ``s``: on an even sample, one ring."""


def knn(
    tree: cKDTree,
    queries: NDArray[Any],
    count: int,
    reach: float = np.inf,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The ``count`` nearest points of a tree to each query, nearest first.

    Args:
        tree: of ``(M, 3)`` points.
        queries: ``(K, 3)``.
        count: neighbours wanted, at most ``M`` unless ``reach`` is finite.
        reach: distance beyond which nothing is found: distance infinity, row ``M``.

    Returns:
        Distances and rows, both ``(K, count)``.
    """
    # A list of ranks, unlike a bare number, keeps the second dimension also for one neighbour.
    distances, rows = tree.query(queries, list(range(1, count + 1)), distance_upper_bound=reach)
    return np.asarray(distances), np.asarray(rows, dtype=np.int64)


def nearest(
    points: NDArray[np.float64], count: int = NEIGHBOURS
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Nearest neighbours, the point itself left out.

    Args:
        points: ``(M, 3)`` float64, distinct.
        count: neighbours wanted. A cloud of fewer than ``count + 1`` points has its furthest
            neighbour repeated, so that the shape of the answer never depends on ``M``.

    Returns:
        Distances ``(M, count)`` float32 in the points' units and rows ``(M, count)`` int32,
        nearest first.
    """
    found = min(count, len(points) - 1)
    distances, rows = nearest_by_leaves(points, found)
    left = np.flatnonzero(rows[:, 0] < 0)
    if len(left):
        distances[left], rows[left] = _by_tree(points, left, found)
    if found < count:
        lack = ((0, 0), (0, count - found))
        distances, rows = np.pad(distances, lack, mode="edge"), np.pad(rows, lack, mode="edge")
    return distances, rows


def _by_tree(
    points: NDArray[np.float64], queries: NDArray[np.intp], count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nearest neighbours of chosen points, themselves left out, one descent of a tree each."""
    far, near = knn(cKDTree(points), points[queries], count + 1)
    # Near-duplicates may come back before the point itself, so column 0 is not always "self".
    own = near == queries[:, None]
    missing = ~own.any(axis=1)
    own[missing, -1] = True
    return far[~own].reshape(-1, count), near[~own].reshape(-1, count)


def spacing(distances: NDArray[np.float32]) -> NDArray[np.float32]:
    """Local spacing ``s``: mean distance to the 8 nearest, ``(M, k)`` -> ``(M,)``, units kept."""
    near = distances[:, :SPACING_NEIGHBOURS]
    mean: NDArray[np.float32] = near.mean(axis=1)
    return np.maximum(mean, np.finfo(np.float32).tiny)
