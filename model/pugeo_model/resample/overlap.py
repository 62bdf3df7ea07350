# SPDX-License-Identifier: Apache-2.0
"""Points of overlapping patches merged by farthest-point sampling, as the paper does."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.farthest import farthest_points
from pugeo_model.geometry.pca_normals import pca_normals
from pugeo_model.resample.atlas import Projected

__all__ = ["PatchPoints", "merge_overlapping"]


@dataclass(frozen=True, eq=False)
class PatchPoints:
    """Samples that a patch network made of one patch.

    Attributes:
        rows: ``(N,)`` int32 rows of the patch's points in the cloud; a row may occur twice.
        points: ``(N, R, 3)`` float64, cloud frame, unit scale.
        normals: ``(N, R, 3)`` float32 unit, or ``None`` from networks without normals.
        coarse_normals: ``(N, 3)`` float32 unit, of the patch's points, or ``None``.
        offcentre: ``(N,)`` float32, distance of the points from the patch's centre, in radii.
    """

    rows: NDArray[np.int32]
    points: NDArray[np.float64]
    normals: NDArray[np.float32] | None
    coarse_normals: NDArray[np.float32] | None
    offcentre: NDArray[np.float32]


def merge_overlapping(
    points: NDArray[np.float64],
    core: NDArray[np.bool_],
    patches: Sequence[PatchPoints],
    wanted: int,
    *,
    keeps_input: bool,
) -> Projected:
    """Choose the output points among the samples of all patches.

    Samples of points outside the core are left to the tile that they belong to. Where the network
    predicts no normals, they are those of a PCA of 16 neighbours in the output (section 4.2).

    Args:
        points: ``(M, 3)`` float64 input points of a tile, unit scale.
        core: ``(M,)`` the points whose samples count.
        patches: of the tile; they cover the core.
        wanted: output points; at most R times the core points.
        keeps_input: the core's input points come first, unmoved, and the rest is chosen to be far
            from them.

    Returns:
        ``wanted`` points. All errors are 1: these networks expect none.
    """
    rows = np.concatenate([np.repeat(p.rows, p.points.shape[1]) for p in patches])
    samples = np.concatenate([p.points.reshape(-1, 3) for p in patches])
    inside = np.flatnonzero(core[rows])
    own = np.flatnonzero(core).astype(np.int32) if keeps_input else np.empty(0, dtype=np.int32)
    chosen = inside[farthest_points(samples[inside], wanted - len(own), points[own])]
    merged = np.concatenate([points[own], samples[chosen]])
    normals = _joined([p.normals for p in patches])
    coarse = _joined([p.coarse_normals for p in patches])
    if normals is None or (keeps_input and coarse is None):
        found = pca_normals(merged)
    else:
        found = normals[chosen]
        if keeps_input:
            assert coarse is not None
            found = np.concatenate([coarse[_most_central(patches, len(points))[own]], found])
    error = np.ones(len(merged), dtype=np.float32)
    return Projected(merged, found, error, np.concatenate([own, rows[chosen]]))


def _joined(parts: Sequence[NDArray[np.float32] | None]) -> NDArray[Any] | None:
    """Vectors of all patches, ``(n, 3)``; ``None`` where a network gives none."""
    there = [part.reshape(-1, 3) for part in parts if part is not None]
    return np.concatenate(there) if there else None


def _most_central(patches: Sequence[PatchPoints], count: int) -> NDArray[np.int64]:
    """For every point, where it lies nearest to a patch's centre: ``(count,)`` joined rows."""
    rows = np.concatenate([p.rows for p in patches])
    best = np.zeros(count, dtype=np.int64)
    order = np.argsort(np.concatenate([p.offcentre for p in patches]), kind="stable")[::-1]
    best[rows[order]] = order  # the last assignment, the most central, stays
    return best
