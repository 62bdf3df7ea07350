# SPDX-License-Identifier: Apache-2.0
"""The charts of a tile (the atlas), and queries and results of projection onto them."""

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
"""Number of nearest charts that are blended at an output point."""


@dataclass(frozen=True, eq=False)
class PatchCharts:
    """The charts of the core of a patch, with their candidates.

    Attributes:
        rows: ``(n,)`` int32 rows of the prepared tile.
        candidates: ``(n, c, 3)`` float32 offsets of the candidates from the points, on the
            tangent planes; frame of the cloud, unit scale.
        T: ``(n, 3, 3)`` float32 augmented Jacobians (eq. 5), in canonical frames.
        code: ``(n, width)`` float16, input of the surface head.
        lift: ``(n,)`` float32 height of the chart above the tangent plane, in spacings.
    """

    rows: NDArray[np.int32]
    candidates: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Atlas:
    """All charts of a tile, in the order of its points.

    Attributes:
        points: ``(M, 3)`` float64, unit scale.
        frames: canonical frames of the points.
        candidates, T, code, lift: as in :class:`PatchCharts`, of the leading points, which have
            charts.
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
        """Join the charts of all patches, in the order of the points.

        Args:
            points: ``(M, 3)`` float64, unit scale.
            frames: canonical frames of the ``M`` points.
            charts: charts of all patches, in any order; together they cover the leading rows.
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
        fixed: number of leading points that keep their positions and only get normals.
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
        normals: ``(m, 3)`` float32, unit length, with the sign of the nearest chart's frame.
        error: ``(m,)`` float32 error that the charts predict, in spacings.
        nearest: ``(m,)`` int32 row of the nearest input point.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    error: NDArray[np.float32]
    nearest: NDArray[np.int32]

    def take(self, rows: NDArray[np.integer[Any]] | slice) -> "Projected":
        """Return the given rows, in that order."""
        return Projected(
            self.points[rows], self.normals[rows], self.error[rows], self.nearest[rows]
        )


def charts_per_candidate(candidates: int) -> int:
    """Return the number of charts that a candidate is projected onto, 1 or 2.

    Fewer than `BLENDED_CHARTS` suffice, since survivors are projected again. If each chart has
    many candidates, the error between charts matters less.

    Args:
        candidates: candidates per chart.
    """
    return 2 if candidates < TUNING.many_candidates else 1
