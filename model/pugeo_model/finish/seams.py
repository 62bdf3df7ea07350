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
from pugeo_model.merge.repulsion import repel

__all__ = ["Rim", "part"]

_CLOSE = 0.8  # reaches: points of one tile are rarely nearer
_AROUND = 1.5  # reaches around such a point within which the others make room
_NEIGHBOURS = 14
_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Rim:
    """The ``k`` points of a tile that lie along its border.

    Attributes:
        rows: ``(k,)`` int64, rows of the tile's answer.
        points: ``(k, 3)`` float64, unit scale of the whole cloud.
        normals: ``(k, 3)`` float32 unit.
        reach: ``(k,)`` float64, distance of neighbours in the packing aimed at; 0 of who stays.
    """

    rows: NDArray[np.int64]
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    reach: NDArray[np.float64]


def part(rims: Sequence[Rim]) -> list[NDArray[np.float64]]:
    """Where the points of each rim lie once none of two tiles are too close: ``(k, 3)`` each."""
    points = np.concatenate([rim.points for rim in rims])
    sizes = [len(rim.points) for rim in rims]
    tile = np.repeat(np.arange(len(rims)), sizes)
    if len(points) <= _NEIGHBOURS:
        return [rim.points for rim in rims]
    reach = np.concatenate([rim.reach for rim in rims])
    tree = cKDTree(points)
    distance, near = knn(tree, points, _NEIGHBOURS + 1)
    distance, near = distance[:, 1:], near[:, 1:]
    # Who stays has no reach: its neighbours' counts.
    widest = np.maximum(reach, reach[near].max(axis=1))
    others = (tile[near] != tile[:, None]) & (distance < _CLOSE * widest[:, None])
    close = np.flatnonzero(others.any(axis=1))
    if not len(close):
        return [rim.points for rim in rims]
    around, _ = cKDTree(points[close]).query(points)
    push = np.where(around < _AROUND * widest, reach, 0.0)
    normals = np.concatenate([rim.normals for rim in rims])
    moved = repel(points, normals, near.astype(np.int32), push, _ROUNDS)
    return np.split(moved, np.cumsum(sizes)[:-1])
