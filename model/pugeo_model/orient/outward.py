# SPDX-License-Identifier: Apache-2.0
"""Which side of a part of the surface is outside, once its normals agree among themselves.

What speaks for a side is summed up for each part in a few numbers that can be added, so that a
cloud cut into tiles comes to the same verdict as one in one piece.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.orient.mst import row_dots
from pugeo_model.tuning import TUNING

__all__ = ["OutwardEvidence", "collect_evidence", "outward_signs"]


@dataclass(frozen=True, eq=False)
class OutwardEvidence:
    """Sums over the points of each of ``P`` parts; a part may have none.

    Attributes:
        count: ``(P,)`` points.
        position: ``(P, 3)`` of the points.
        normal: ``(P, 3)`` of the normals.
        area: ``(P,)`` that the points stand for, up to a common factor.
        flux: ``(P, 3)`` of area times normal.
        volume: ``(P,)`` of area times position along the normal.
        scale: ``(P,)`` of area times distance from the part's centre.
        ends: ``(P, 3, 2)`` lowest and highest coordinate of each axis.
        end_normals: ``(P, 3, 2)`` along that axis, of the normals there.
    """

    count: NDArray[np.float64]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    area: NDArray[np.float64]
    flux: NDArray[np.float64]
    volume: NDArray[np.float64]
    scale: NDArray[np.float64]
    ends: NDArray[np.float64]
    end_normals: NDArray[np.float64]

    @classmethod
    def join(cls, several: "list[OutwardEvidence]") -> "OutwardEvidence":
        """The parts of all, one after the other."""
        return cls(
            *(np.concatenate([getattr(each, f.name) for each in several]) for f in fields(cls))
        )


def collect_evidence(
    points: NDArray[np.float64],
    normals: NDArray[Any],
    parts: NDArray[np.intp],
    total: int,
    neighbours: NDArray[np.integer[Any]],
    core: NDArray[np.bool_],
) -> OutwardEvidence:
    """Sum up what speaks for a side.

    Args:
        points: ``(M, 3)``.
        normals: ``(M, 3)``, consistent within each part.
        parts: ``(M,)`` in ``0..total-1``.
        total: number of parts.
        neighbours: ``(M, k)`` rows.
        core: ``(M,)`` points that count.
    """
    area = _areas(points, neighbours)[core]
    points, parts = points[core], parts[core]
    normals = normals[core].astype(np.float64)

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        if values.ndim == 1:
            return np.bincount(parts, values, total).astype(np.float64, copy=False)
        return np.stack([np.bincount(parts, each, total) for each in values.T], axis=1)

    count = np.bincount(parts, minlength=total).astype(np.float64)
    position = summed(points)
    centre = position / np.maximum(count, 1.0)[:, None]
    arms = points - centre[parts]
    ends = np.stack([np.full((total, 3), np.inf), np.full((total, 3), -np.inf)], axis=2)
    end_normals = np.zeros((total, 3, 2))
    _find_ends(points, normals, parts, ends, end_normals)
    return OutwardEvidence(
        count=count,
        position=position,
        normal=summed(normals),
        area=summed(area),
        flux=summed(area[:, None] * normals),
        volume=summed(area * row_dots(points, normals)),
        scale=summed(area * np.sqrt(row_dots(arms, arms))),
        ends=ends,
        end_normals=end_normals,
    )


def outward_signs(
    evidence: OutwardEvidence, groups: NDArray[np.intp], signs: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sign of each group of parts as a whole, ``(groups,)``.

    By the sign of its volume where it encloses one; else by the normals of its six outermost
    points; else, where it is flat and these cancel out, upward.

    Args:
        evidence: of ``P`` parts.
        groups: ``(P,)`` group of each part, numbered from 0.
        signs: ``(P,)`` by which the normals of each part are multiplied first.
    """
    total = int(groups.max()) + 1

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros((total, *values.shape[1:]))
        np.add.at(out, groups, values)
        return out

    count = np.maximum(summed(evidence.count), 1.0)[:, None]
    centre = summed(evidence.position) / count
    here = centre[groups]
    volume = summed(signs * (evidence.volume - row_dots(here, evidence.flux)))
    own = evidence.position / np.maximum(evidence.count, 1.0)[:, None]
    apart = np.where(evidence.count > 0, np.linalg.norm(own - here, axis=1), 0.0)
    scale = summed(np.hypot(evidence.scale, evidence.area * apart))
    outermost = np.zeros(total)
    for axis in range(3):
        for end, direction in enumerate((-1.0, 1.0)):
            order = np.lexsort([direction * evidence.ends[:, axis, end], groups])
            last = order[np.cumsum(np.bincount(groups)) - 1]
            outermost += direction * signs[last] * evidence.end_normals[last, axis, end]
    mean = summed(signs[:, None] * evidence.normal) / count
    upward = mean @ np.array([0.01, 0.1, 1.0])
    closed = np.abs(volume) > TUNING.clear_volume * scale
    verdict = np.where(closed, volume, np.where(np.abs(outermost) > 0.5, outermost, upward))
    return np.where(verdict < 0, -1.0, 1.0)


@njit(cache=True, nogil=True)
def _find_ends(
    points: NDArray[Any],
    normals: NDArray[Any],
    parts: NDArray[Any],
    ends: NDArray[Any],
    end_normals: NDArray[Any],
) -> None:
    """Lowest and highest coordinate of each part, and the normals there."""
    for i in range(len(points)):
        part = parts[i]
        for axis in range(3):
            if points[i, axis] < ends[part, axis, 0]:
                ends[part, axis, 0] = points[i, axis]
                end_normals[part, axis, 0] = normals[i, axis]
            if points[i, axis] >= ends[part, axis, 1]:
                ends[part, axis, 1] = points[i, axis]
                end_normals[part, axis, 1] = normals[i, axis]


@njit(cache=True, nogil=True)
def _areas(points: NDArray[Any], neighbours: NDArray[Any]) -> NDArray[np.float64]:
    """Area that each point stands for, up to a common factor: squared distance to neighbours."""
    count = len(points)
    areas = np.empty(count)
    for i in range(count):
        total, valid = 0.0, 0
        for j in neighbours[i]:
            if 0 <= j < count:
                for a in range(3):
                    total += (points[j, a] - points[i, a]) ** 2
                valid += 1
        areas[i] = total / max(valid, 1)
    return areas
