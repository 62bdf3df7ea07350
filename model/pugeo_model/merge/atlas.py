# SPDX-License-Identifier: Apache-2.0
"""The atlas: charts of all patches side by side, and the parcels of spots to land on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.geometry.frames import Frames
from pugeo_model.merge.crowd import by_chart
from pugeo_model.merge.placement import nearest_charts

__all__ = ["BLENDED", "Atlas", "Landed", "Landing", "PatchCharts", "bind", "parcels", "screened"]

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
    """Charts of the whole cloud, rows as the cloud's; fields as in :class:`PatchCharts`."""

    candidates: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Landing:
    """Spots to be landed, with the charts they need.

    Attributes:
        spots: ``(m, 3)`` float64, unit scale.
        charts: ``(m, k)`` int32 rows of the arrays below, nearest first.
        points: ``(n, 3)`` float64; the rest as in :class:`PatchCharts` and ``Frames``.
        nearest: ``(m,)`` int32 row in the cloud of the nearest input point.
        fixed: the spots stay where they are and only get normals.
    """

    spots: NDArray[np.float64]
    charts: NDArray[np.int32]
    points: NDArray[np.float64]
    axes: NDArray[np.float32]
    spacing: NDArray[np.float32]
    quadric: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]
    nearest: NDArray[np.int32]
    fixed: bool


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

    @classmethod
    def join(cls, parts: "Sequence[Landed]") -> "Landed":
        """All parts as one, in their order."""
        return cls(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.error for part in parts]),
            np.concatenate([part.nearest for part in parts]),
        )


def bind(charts: Sequence[PatchCharts]) -> Atlas:
    """Put the charts of all patches into the rows of the cloud, whatever order they come in."""
    back = np.argsort(np.concatenate([part.rows for part in charts]))
    return Atlas(
        np.concatenate([part.candidates for part in charts])[back],
        np.concatenate([part.T for part in charts])[back],
        np.concatenate([part.code for part in charts])[back],
        np.concatenate([part.lift for part in charts])[back],
    )


def screened(candidates: int) -> int:
    """Charts that a candidate lands on: one more would move what survives, and that lands again.

    Args:
        candidates: of each chart. Where they are many, those between charts matter less.
    """
    return 2 if candidates < _MANY else 1


def parcels(
    atlas: Atlas,
    spots: NDArray[np.float64],
    owner: NDArray[np.int32],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    frames: Frames,
    ends: NDArray[np.int64],
    blended: int = BLENDED,
    *,
    fixed: bool = False,
) -> list[Landing]:
    """Spots with the charts nearest to each, one parcel a patch.

    Args:
        atlas: the charts.
        spots: ``(K, 3)`` float64.
        owner: ``(K,)`` int32 chart that each spot came from.
        points: ``(M, 3)`` float64.
        neighbours: ``(M, k)`` int32.
        frames: of the ``M`` points.
        ends: ``(patches - 1,)`` first rows of all patches but the first.
        blended: charts a spot lands on.
        fixed: the spots stay where they are.
    """
    near = nearest_charts(spots, owner, points, neighbours, blended)
    patch = np.searchsorted(ends, np.arange(len(points)), side="right").astype(np.int32)
    start, order = by_chart(patch[owner], len(ends) + 1)
    found = []
    place = np.full(len(points), -1, dtype=np.int32)
    for part in np.split(order, start[1:-1]):
        used, local = _renumber(near[part], place)
        found.append(
            Landing(
                spots=spots[part],
                charts=local,
                points=points[used],
                axes=frames.axes[used],
                spacing=frames.spacing[used],
                quadric=frames.quadric[used],
                T=atlas.T[used],
                code=atlas.code[used],
                lift=atlas.lift[used],
                nearest=near[part, 0],
                fixed=fixed,
            )
        )
    return found


@njit(cache=True, nogil=True)
def _renumber(rows, place):  # type: ignore[no-untyped-def]
    """Rows in the order they first occur, and each row's number; ``place`` is -1 all over."""
    used = np.empty(rows.size, dtype=np.int32)
    local = np.empty_like(rows)
    count = 0
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            row = rows[i, j]
            if place[row] < 0:
                place[row] = count
                used[count] = row
                count += 1
            local[i, j] = place[row]
    used = used[:count].copy()
    for row in used:
        place[row] = -1
    return used, local
