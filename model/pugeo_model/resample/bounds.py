# SPDX-License-Identifier: Apache-2.0
"""Largest distance of an output point from the input: smaller beyond the rim of the scan.

Between input points the surface is known on all sides. Beyond an open rim, the edge of a shadow or
the tip of a fin, the input lies on one side only, and a chart extrapolates. The widest sector
around a point without input tells the two cases apart.

In a scan the surface is not known everywhere between the points either, as where rings are wide
apart or a thin part has few of them. The charts expect a larger error there, and the distance is
reduced in inverse proportion to it.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["are_beyond", "bounded_spacing", "distance_bounds"]

_SECTORS = 36
_REACH = 3.0  # spacings within which input is searched
_CLOSE = 1.8  # spacings within which input lies along the surface of a point
_INSIDE, _OUTSIDE = TUNING.largest_offset, TUNING.rim_offset
_OPEN, _STEEP = TUNING.open_sector, TUNING.other_surface


def bounded_spacing(
    spacing: NDArray[np.float32], neighbours: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Return spacings ``(M,)`` bounded by those around, so that an isolated chart has no room."""
    around = np.median(spacing[neighbours], axis=1)
    bounded: NDArray[np.float32] = np.minimum(spacing, np.float32(TUNING.isolated_spacing) * around)
    return bounded


def distance_bounds(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    charts: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    spacing: NDArray[np.float32],
    max_gap: float | None,
    *,
    shadows: bool,
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Compute the largest distance of each point from its nearest chart.

    Args:
        points: ``(K, 3)``.
        normals: ``(K, 3)`` unit length, of any sign.
        owner: ``(K,)`` int32 a chart near each.
        charts: ``(M, 3)`` points of the charts.
        neighbours: ``(M, k)`` charts near each chart.
        spacing: ``(M,)``, see `bounded_spacing`.
        max_gap: no distance is larger, by default no bound.
        shadows: points whose surroundings are not along their tangent plane count as outside, as
            between an object and the ground in its shadow. Clean input would get holes at creases.

    Returns:
        Distances ``(K,)`` and the nearest charts ``(K,)``.
    """
    limit, nearest = np.empty(len(points)), np.empty(len(points), dtype=np.int32)
    _bounds(points, normals, owner, charts, neighbours, spacing, shadows, limit, nearest)
    return limit if max_gap is None else np.minimum(limit, max_gap), nearest


def are_beyond(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    charts: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    spacing: NDArray[np.float32],
    max_gap: float | None,
    *,
    shadows: bool,
    error: NDArray[np.float32] | None = None,
) -> NDArray[np.bool_]:
    """Return which points are too far from the input, ``(K,)``.

    The bound is that of `distance_bounds`. If errors are given, it is multiplied by
    ``min(1, TUNING.sure_error / error)``.

    Args:
        error: ``(K,)`` expected error of each point, in spacings, of a scan.
    """
    limit, nearest = distance_bounds(
        points, normals, owner, charts, neighbours, spacing, max_gap, shadows=shadows
    )
    if error is not None:
        limit *= TUNING.sure_error / np.maximum(error, TUNING.sure_error)
    far: NDArray[np.bool_] = ((points - charts[nearest]) ** 2).sum(axis=1) > limit * limit
    return far


@njit(cache=True, nogil=True)
def _bounds(points, normals, owner, charts, neighbours, spacing, shadows, limit, nearest):  # type: ignore[no-untyped-def]
    """Bounds of the points; writes ``limit`` and ``nearest``."""
    filled = np.empty(_SECTORS, dtype=np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
        # Two directions perpendicular to the normal (Duff et al. 2017).
        sign = 1.0 if c >= 0.0 else -1.0
        p = -1.0 / (sign + c)
        q = a * b * p
        t0, t1, t2 = 1.0 + sign * a * a * p, sign * q, -sign * a
        s0, s1, s2 = q, sign + b * b * p, -b
        filled[:] = False
        own = owner[i]
        best, least = own, np.inf
        reach = _REACH * spacing[own]
        close = (_CLOSE * spacing[own]) ** 2
        heights = several = 0.0
        for at in range(-1, neighbours.shape[1]):
            other = own if at < 0 else neighbours[own, at]
            dx, dy, dz = charts[other, 0] - x, charts[other, 1] - y, charts[other, 2] - z
            squared = dx * dx + dy * dy + dz * dz
            if squared < least:
                best, least = other, squared
            if squared > reach * reach:
                continue
            if squared <= close:
                heights += abs(a * dx + b * dy + c * dz)
                several += 1.0
            u, v = t0 * dx + t1 * dy + t2 * dz, s0 * dx + s1 * dy + s2 * dz
            turn = np.arctan2(v, u) / (2.0 * np.pi) + 0.5
            filled[min(int(turn * _SECTORS), _SECTORS - 1)] = True
        longest = run = 0
        for at in range(2 * _SECTORS):
            run = 0 if filled[at % _SECTORS] else run + 1
            longest = max(longest, run)
        nearest[i] = best
        wide = longest * (360.0 / _SECTORS) > _OPEN
        steep = shadows and heights > _STEEP * spacing[own] * several
        limit[i] = spacing[best] * (_OUTSIDE if wide or steep else _INSIDE)
