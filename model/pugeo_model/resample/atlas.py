# SPDX-License-Identifier: Apache-2.0
"""The atlas: charts of all patches side by side, and spots to land on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.frames import Frames

__all__ = ["BLENDED", "Atlas", "Landed", "Landing", "PatchCharts", "bind", "screened"]

BLENDED = 3
"""Charts that every point lands on."""

_MANY = 12  # candidates a chart, of 8 points and more


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


@dataclass(frozen=True, eq=False)
class Landing:
    """Spots to be landed.

    Attributes:
        atlas: the charts.
        spots: ``(m, 3)`` float64, unit scale.
        charts: ``(m, k)`` int32 rows of the atlas, nearest first.
        fixed: so many of the first spots stay where they are and only get normals.
    """

    atlas: Atlas
    spots: NDArray[np.float64]
    charts: NDArray[np.int32]
    fixed: int = 0


@dataclass(frozen=True, eq=False)
class Landed:
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

    def take(self, rows: NDArray[np.integer[Any]] | slice) -> "Landed":
        """The points of the given rows, in that order."""
        return Landed(self.points[rows], self.normals[rows], self.error[rows], self.nearest[rows])


def bind(points: NDArray[np.float64], frames: Frames, charts: Sequence[PatchCharts]) -> Atlas:
    """Put the charts of all patches side by side, whatever order they come in.

    Args:
        points: ``(M, 3)`` float64.
        frames: of the ``M`` points.
        charts: of all patches; the rows of each follow those of another.
    """
    parts = sorted(charts, key=lambda part: int(part.rows[0]))
    return Atlas(
        points,
        frames,
        np.concatenate([part.candidates for part in parts]),
        np.concatenate([part.T for part in parts]),
        np.concatenate([part.code for part in parts]),
        np.concatenate([part.lift for part in parts]),
    )


def screened(candidates: int) -> int:
    """Charts that a candidate lands on: one more would move what survives, and that lands again.

    Args:
        candidates: of each chart. Where they are many, those between charts matter less.
    """
    return 2 if candidates < _MANY else 1
