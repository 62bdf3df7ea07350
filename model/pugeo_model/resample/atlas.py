# SPDX-License-Identifier: Apache-2.0
"""The charts of a tile side by side (the atlas), and the points that are projected onto them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.frames import Frames
from pugeo_model.tuning import TUNING

__all__ = [
    "BLENDED_CHARTS",
    "Atlas",
    "PatchCharts",
    "Projected",
    "ProjectionQuery",
    "charts_per_candidate",
]

BLENDED_CHARTS = TUNING.blended_charts
"""Number of nearest charts that a point of the answer is blended from."""


@dataclass(frozen=True, eq=False)
class PatchCharts:
    """Charts of a patch's core and what they propose.

    Attributes:
        rows: ``(n,)`` int32 rows in the cloud.
        candidates: ``(n, c, 3)`` float32 offsets from the points, cloud frame, unit scale, on the
            tangent planes.
        T: ``(n, 3, 3)`` float32, in canonical frames.
        code: ``(n, width)`` float16, what the surface head needs of the feature.
        lift: ``(n,)`` float32, in spacings.
    """

    rows: NDArray[np.int32]
    candidates: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Atlas:
    """Charts of a tile, rows as its points.

    Attributes:
        points: ``(M, 3)`` float64, unit scale.
        frames: of the points.
        candidates, T, code, lift: as in :class:`PatchCharts`, of the points that got charts. These
            lead.
    """

    points: NDArray[np.float64]
    frames: Frames
    candidates: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]

    @classmethod
    def of(
        cls, points: NDArray[np.float64], frames: Frames, charts: Sequence[PatchCharts]
    ) -> "Atlas":
        """Put the charts of all patches side by side, in the order of the points.

        Args:
            points: ``(M, 3)`` float64, unit scale.
            frames: of the ``M`` points.
            charts: of all patches, in any order; together their rows are those that lead.
        """
        parts = sorted(charts, key=lambda part: int(part.rows[0]))
        return cls(
            points,
            frames,
            np.concatenate([part.candidates for part in parts]),
            np.concatenate([part.T for part in parts]),
            np.concatenate([part.code for part in parts]),
            np.concatenate([part.lift for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class ProjectionQuery:
    """Points to be projected onto the charts near them.

    Attributes:
        atlas: the charts.
        points: ``(m, 3)`` float64, unit scale.
        charts: ``(m, k)`` int32 rows of the atlas, nearest first.
        fixed: number of leading points that stay in place and only get normals.
    """

    atlas: Atlas
    points: NDArray[np.float64]
    charts: NDArray[np.int32]
    fixed: int = 0


@dataclass(frozen=True, eq=False)
class Projected:
    """Points on the surface.

    Attributes:
        points: ``(m, 3)`` float64, unit scale.
        normals: ``(m, 3)`` float32 unit, sign that of the nearest chart's frame.
        error: ``(m,)`` float32, expected by the charts themselves, in spacings.
        nearest: ``(m,)`` int32 row in the cloud of the nearest input point.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    error: NDArray[np.float32]
    nearest: NDArray[np.int32]

    def take(self, rows: NDArray[np.integer[Any]] | slice) -> "Projected":
        """The points of the given rows, in that order."""
        return Projected(
            self.points[rows], self.normals[rows], self.error[rows], self.nearest[rows]
        )


def charts_per_candidate(candidates: int) -> int:
    """Number of charts that a candidate is projected onto, 1 or 2.

    Fewer than `BLENDED_CHARTS` suffice: survivors are projected again. Where a chart has many
    candidates, those between charts matter less.

    Args:
        candidates: of each chart.
    """
    return 2 if candidates < TUNING.many_candidates else 1
