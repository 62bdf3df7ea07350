# SPDX-License-Identifier: Apache-2.0
"""Points of two tiles that came too close to each other.

Tiles see the same candidates along their border, and mostly keep the same. But each thins its own
to a number of its own, and where one keeps a candidate that the other drops, two of the answer's
points can come to lie on one spot. Once both are known they are pushed apart.
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

_CLOSE = 0.8  # radii: points of one tile are rarely nearer, so who is nearer is the nearest
_AROUND = 1.5  # radii around such a point within which the others make room
_SEEN = 3.0  # radii within which there may be who pushes them
_NEIGHBOURS = 14


@dataclass(frozen=True, eq=False)
class BorderPoints:
    """The ``k`` points of a tile that lie along its border.

    Attributes:
        rows: ``(k,)`` int32, rows of the tile's answer.
        points: ``(k, 3)`` float64, unit scale of the whole cloud.
        normals: ``(k, 3)`` float32 unit.
        radius: ``(k,)`` float64, distance of neighbours in the packing aimed at; 0 of who stays.
        outermost: ``(k,)`` which may have one of another tile as their nearest.
    """

    rows: NDArray[np.int32]
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    radius: NDArray[np.float64]
    outermost: NDArray[np.bool_]


def separate(rims: Sequence[BorderPoints]) -> list[NDArray[np.float64]]:
    """Push points of two tiles apart that are too close, and what is around them out of the way.

    Returns:
        ``(k, 3)`` float64 of each rim; most are where they were.
    """
    if not rims:
        return []
    points, normals, radius, outermost = (
        np.concatenate([getattr(rim, name) for rim in rims])
        for name in ("points", "normals", "radius", "outermost")
    )
    sizes = [len(rim.points) for rim in rims]
    if len(points) > 1:
        tile = np.repeat(np.arange(len(rims)), sizes)
        some, push, lists = _too_close(points, radius, tile, np.flatnonzero(outermost))
        if len(some):
            points[some] = repel(points[some], normals[some], lists, push, TUNING.repulsion_rounds)
    return np.split(points, np.cumsum(sizes)[:-1])


def _too_close(
    points: NDArray[np.float64],
    radius: NDArray[np.float64],
    tile: NDArray[np.int64],
    outermost: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]:
    """Rows of the points around those too close to one of another tile; how they push and whom.

    They are few, so that most are asked for no neighbour at all.
    """
    distance, near = knn(cKDTree(points), points[outermost], 2)
    # Not always the second: of two on one spot either may come first.
    other = np.where(near[:, 0] == outermost, near[:, 1], near[:, 0])
    # Who stays has no radius: that of the next counts.
    local = radius.copy()
    local[outermost] = np.maximum(radius[outermost], radius[other])
    foreign = tile[other] != tile[outermost]
    close = outermost[foreign & (distance[:, 1] < _CLOSE * local[outermost])]
    if not len(close):
        return close, np.empty(0), np.empty((0, 0), dtype=np.int32)
    apart, which = knn(cKDTree(points[close]), points, 1, _SEEN * radius.max())
    apart, local = apart[:, 0], np.maximum(local, np.append(local[close], 0.0)[which[:, 0]])
    some = np.flatnonzero(apart < _SEEN * local)
    push = np.where(apart[some] < _AROUND * local[some], radius[some], 0.0)
    _, lists = knn(cKDTree(points[some]), points[some], min(_NEIGHBOURS + 1, len(some)))
    # Each is on its own list, which pushes it nowhere.
    return some, push, lists.astype(np.int32)
