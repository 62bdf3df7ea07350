# SPDX-License-Identifier: Apache-2.0
"""Separation of output points of different tiles that are too close to each other.

Neighbouring tiles have the same candidates along their border and mostly select the same. But
each tile selects its own number, and where one keeps a candidate that the other drops, two output
points may nearly coincide. They are pushed apart when both tiles are known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.resample.repulsion import repel
from pugeo_model.tuning import TUNING

__all__ = ["BorderPoints", "separate"]


@dataclass(frozen=True, eq=False)
class BorderPoints:
    """The ``k`` output points of a tile along its border.

    Attributes:
        rows: ``(k,)`` int32, rows of the tile's output.
        points: ``(k, 3)`` float64, unit scale of the whole cloud.
        normals: ``(k, 3)`` float32, unit length.
        radius: ``(k,)`` float64 packing radius; 0 for points that must not move.
        outermost: ``(k,)`` bool, points whose nearest point may belong to another tile.
        room: ``(k,)`` float64 by which a point may move and still be near enough to the input.
    """

    rows: NDArray[np.int32]
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    radius: NDArray[np.float64]
    outermost: NDArray[np.bool_]
    room: NDArray[np.float64]


def separate(borders: Sequence[BorderPoints]) -> list[NDArray[np.float64]]:
    """Push points of different tiles apart that are too close, and the points around them.

    Args:
        borders: of all tiles that have border points.

    Returns:
        New positions ``(k, 3)`` float64 for each tile; most are unchanged.
    """
    if not borders:
        return []
    points, normals, radius, outermost, room = (
        np.concatenate([getattr(border, name) for border in borders])
        for name in ("points", "normals", "radius", "outermost", "room")
    )
    sizes = [len(border.points) for border in borders]
    if len(points) > 1:
        tile = np.repeat(np.arange(len(borders)), sizes)
        rows, push, lists = _too_close(points, radius, tile, np.flatnonzero(outermost))
        if len(rows):
            moved = repel(points[rows], normals[rows], lists, push, TUNING.repulsion_rounds)
            offset = moved - points[rows]
            length = np.maximum(np.linalg.norm(offset, axis=1), 1e-300)
            points[rows] += offset * np.minimum(1.0, room[rows] / length)[:, None]
    return np.split(points, np.cumsum(sizes)[:-1])


def _too_close(
    points: NDArray[np.float64],
    radius: NDArray[np.float64],
    tile: NDArray[np.int64],
    outermost: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]:
    """Find the points that are too close to another tile, and the points around them.

    Returns:
        Rows of these points (few), their packing radii (0 if they push but do not move), and
        their neighbours, as rows of the first array.
    """
    distance, near = knn(cKDTree(points), points[outermost], 2)
    # Either of two coincident points may come first, so column 0 is not always the point itself.
    other = np.where(near[:, 0] == outermost, near[:, 1], near[:, 0])
    # A fixed point has radius 0; the radius of its neighbour is used instead.
    local = radius.copy()
    local[outermost] = np.maximum(radius[outermost], radius[other])
    foreign = tile[other] != tile[outermost]
    close = outermost[foreign & (distance[:, 1] < TUNING.seam_close * local[outermost])]
    if not len(close):
        return close, np.empty(0), np.empty((0, 0), dtype=np.int32)
    pushing = TUNING.seam_pushing
    gap, which = knn(cKDTree(points[close]), points, 1, pushing * radius.max())
    gap, local = gap[:, 0], np.maximum(local, np.append(local[close], 0.0)[which[:, 0]])
    rows = np.flatnonzero(gap < pushing * local)
    push = np.where(gap[rows] < TUNING.seam_moved * local[rows], radius[rows], 0.0)
    count = min(TUNING.seam_neighbours + 1, len(rows))
    _, lists = knn(cKDTree(points[rows]), points[rows], count)
    # Each point is in its own list; at distance 0 it does not push.
    return rows, push, lists.astype(np.int32)
