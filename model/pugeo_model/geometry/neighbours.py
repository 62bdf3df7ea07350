# SPDX-License-Identifier: Apache-2.0
"""The k nearest neighbours of each point, and the local spacing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.knn import nearest_by_leaves

__all__ = ["NEIGHBOURS", "SPACING_NEIGHBOURS", "knn", "nearest", "spacing"]

NEIGHBOURS = 32
"""Neighbours in the neighbourhood of a point."""

SPACING_NEIGHBOURS = 8
"""Neighbours whose mean distance is the local spacing ``s``: one ring of an even sample."""


def knn(
    tree: cKDTree,
    queries: NDArray[Any],
    count: int,
    radius: float = np.inf,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Find the ``count`` nearest points of a tree to each query.

    Args:
        tree: tree of ``(M, 3)`` points.
        queries: ``(K, 3)``.
        count: number of neighbours, at most ``M`` unless ``radius`` is finite.
        radius: largest distance; missing neighbours have distance infinity and row ``M``.

    Returns:
        Distances and rows, both ``(K, count)``, nearest first.
    """
    # A list of ranks, unlike a number, keeps the second dimension also for one neighbour.
    distances, rows = tree.query(queries, list(range(1, count + 1)), distance_upper_bound=radius)
    return np.asarray(distances), np.asarray(rows, dtype=np.int64)


def nearest(
    points: NDArray[np.float64], count: int = NEIGHBOURS
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Find the nearest neighbours of each point, without the point itself.

    Args:
        points: ``(M, 3)`` float64, distinct, at least 2.
        count: number of neighbours. If there are fewer, the furthest one is repeated.

    Returns:
        Distances ``(M, count)`` float32 in units of the points and rows ``(M, count)`` int32,
        nearest first.
    """
    found = min(count, len(points) - 1)
    distances, rows = nearest_by_leaves(points, found)
    missing = np.flatnonzero(rows[:, 0] < 0)
    if len(missing):
        distances[missing], rows[missing] = _by_tree(points, missing, found)
    if found < count:
        padding = ((0, 0), (0, count - found))
        distances = np.pad(distances, padding, mode="edge")
        rows = np.pad(rows, padding, mode="edge")
    return distances, rows


def _by_tree(
    points: NDArray[np.float64], queries: NDArray[np.intp], count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nearest neighbours of some points (rows ``queries``), without the points themselves."""
    distances, rows = knn(cKDTree(points), points[queries], count + 1)
    # A near-duplicate may precede the point itself, so column 0 is not always the point.
    itself = rows == queries[:, None]
    absent = ~itself.any(axis=1)
    itself[absent, -1] = True
    return distances[~itself].reshape(-1, count), rows[~itself].reshape(-1, count)


def spacing(distances: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the local spacing ``s``, the mean distance to the 8 nearest neighbours.

    Args:
        distances: ``(M, k)`` float32, nearest first.

    Returns:
        ``(M,)`` float32 > 0, in the same units.
    """
    near = distances[:, :SPACING_NEIGHBOURS]
    mean: NDArray[np.float32] = near.mean(axis=1)
    return np.maximum(mean, np.finfo(np.float32).tiny)
