# SPDX-License-Identifier: Apache-2.0
"""The outer side of each connected part of a surface whose normals are consistent.

The evidence of each part is a few sums, which can be added over tiles, so that a cloud in tiles
and the same cloud in one piece are oriented the same way. The main evidence is the enclosed
volume by the divergence theorem: ``3 V = sum_i a_i x_i . n_i`` with areas a, points x, normals n.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.orient.signs import row_dots
from pugeo_model.tuning import TUNING

__all__ = ["OutwardEvidence", "collect_evidence", "outward_signs"]


@dataclass(frozen=True, eq=False)
class OutwardEvidence:
    """Sums over the points of each of ``P`` parts; a part may have no points.

    Attributes:
        count: ``(P,)`` number of points.
        position: ``(P, 3)`` sum of positions.
        normal: ``(P, 3)`` sum of normals.
        area: ``(P,)`` sum of areas, up to a common factor.
        flux: ``(P, 3)`` sum of area times normal.
        volume: ``(P,)`` sum of area times dot product of position and normal.
        scale: ``(P,)`` sum of area times distance from the centre of the part.
        ends: ``(P, 3, 2)`` lowest and highest coordinate along each axis.
        end_normals: ``(P, 3, 2)`` component along that axis of the normal at that point.
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
        """Concatenate the parts of several tiles."""
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
    """Compute the evidence of each part.

    Args:
        points: ``(M, 3)`` float64.
        normals: ``(M, 3)``, consistent within each part.
        parts: ``(M,)`` part of each point, in ``0..total-1``.
        total: number of parts.
        neighbours: ``(M, k)`` rows.
        core: ``(M,)`` bool, points that count.
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
    offsets = points - centre[parts]
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
        scale=summed(area * np.sqrt(row_dots(offsets, offsets))),
        ends=ends,
        end_normals=end_normals,
    )


def outward_signs(
    evidence: OutwardEvidence, groups: NDArray[np.intp], signs: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Determine the sign of each group of parts.

    The sign of the enclosed volume decides; if there is no clear one, the normals at the six
    outermost points; if these cancel out, as on a flat part, the normals are oriented upward.

    Args:
        evidence: of ``P`` parts.
        groups: ``(P,)`` group of each part, numbered from 0.
        signs: ``(P,)`` -1 or 1, relative signs of the parts within their group.

    Returns:
        -1 or 1 ``(groups,)``.
    """
    total = int(groups.max()) + 1

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros((total, *values.shape[1:]))
        np.add.at(out, groups, values)
        return out

    count = np.maximum(summed(evidence.count), 1.0)[:, None]
    centre = summed(evidence.position) / count
    group_centre = centre[groups]
    volume = summed(signs * (evidence.volume - row_dots(group_centre, evidence.flux)))
    part_centre = evidence.position / np.maximum(evidence.count, 1.0)[:, None]
    distance = np.linalg.norm(part_centre - group_centre, axis=1)
    distance = np.where(evidence.count > 0, distance, 0.0)
    scale = summed(np.hypot(evidence.scale, evidence.area * distance))
    outermost = np.zeros(total)
    for axis in range(3):
        for end, direction in enumerate((-1.0, 1.0)):
            order = np.lexsort([direction * evidence.ends[:, axis, end], groups])
            last = order[np.cumsum(np.bincount(groups)) - 1]
            outermost += direction * signs[last] * evidence.end_normals[last, axis, end]
    mean = summed(signs[:, None] * evidence.normal) / count
    upward = mean @ np.array([0.01, 0.1, 1.0])
    closed = np.abs(volume) > TUNING.clear_volume * scale
    clear = np.abs(outermost) > TUNING.clear_extremes
    decision = np.where(closed, volume, np.where(clear, outermost, upward))
    return np.where(decision < 0, -1.0, 1.0)


@njit(cache=True, nogil=True)
def _find_ends(
    points: NDArray[Any],
    normals: NDArray[Any],
    parts: NDArray[Any],
    ends: NDArray[Any],
    end_normals: NDArray[Any],
) -> None:
    """Find the lowest and highest coordinates of each part and the normals there."""
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
    """Area of each point, up to a common factor: mean squared distance to its neighbours."""
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
