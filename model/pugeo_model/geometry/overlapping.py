# SPDX-License-Identifier: Apache-2.0
"""Overlapping patches by farthest-point seeds (Qian et al. 2020, section 3.1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.farthest import farthest_points
from pugeo_model.geometry.neighbours import knn

__all__ = [
    "OVERLAP",
    "PATCH_POINTS",
    "PointPatch",
    "normalise_patch",
    "overlapping_patches",
    "patch_count",
]

PATCH_POINTS = 256
"""Points N of a patch."""

OVERLAP = 3
"""Patches that a point lies in, on average: the paper's successors and PU-Net take three."""


@dataclass(frozen=True, eq=False)
class PointPatch:
    """N neighbouring points, centred and of radius 1.

    Attributes:
        rows: ``(N,)`` int32 rows in the cloud.
        points: ``(N, 3)`` float32, centred on their mean, the farthest at distance 1.
        centre: ``(3,)`` float64, in the cloud's frame.
        radius: in the cloud's unit.
    """

    rows: NDArray[np.int32]
    points: NDArray[np.float32]
    centre: NDArray[np.float64]
    radius: float


def normalise_patch(
    points: NDArray[np.floating[Any]],
) -> tuple[NDArray[np.float32], NDArray[Any], float]:
    """Points ``(N, 3)`` centred and scaled to radius 1, their centre ``(3,)`` and radius."""
    centre = points.mean(axis=0)
    centred = points - centre
    radius = float(np.linalg.norm(centred, axis=1).max()) or 1.0
    return (centred / radius).astype(np.float32), centre, radius


def patch_count(count: int) -> int:
    """Patches that ``count`` points are cut into, up to those that fill gaps."""
    return 1 if count <= PATCH_POINTS else -(-OVERLAP * count // PATCH_POINTS)


def overlapping_patches(
    points: NDArray[np.float64], size: int = PATCH_POINTS, overlap: int = OVERLAP
) -> list[PointPatch]:
    """Patches around farthest-point seeds, until every point lies in one at least.

    ``ceil(overlap * M / size)`` seeds; a point in none of their patches becomes a seed too.

    Args:
        points: ``(M, 3)`` float64, distinct.
        size: points N of a patch. A cloud with fewer points is one patch, filled up by repeating
            points in order, since the networks' graphs need N points.
        overlap: patches that a point lies in, on average.
    """
    count = len(points)
    if count <= size:
        return [_patch(points, np.resize(np.arange(count), size))]
    seeds = farthest_points(points, -(-overlap * count // size))
    tree = cKDTree(points)
    patches = []
    covered = np.zeros(count, dtype=np.bool_)
    pending = list(seeds)
    while pending:
        rows = knn(tree, points[pending], size)[1]
        covered[rows] = True
        patches += [_patch(points, each) for each in rows]
        left = np.flatnonzero(~covered)
        # One at a time: its patch covers others that were left with it.
        pending = left[:1].tolist()
    return patches


def _patch(points: NDArray[np.float64], rows: NDArray[np.integer[Any]]) -> PointPatch:
    local, centre, radius = normalise_patch(points[rows])
    return PointPatch(rows.astype(np.int32), local, centre, radius)
