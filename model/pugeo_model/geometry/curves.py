# SPDX-License-Identifier: Apache-2.0
"""Points of wires and single scan lines: moved onto the curve."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.curve_fit import (
    CURVE,
    LENGTH,
    ORIGIN,
    RADIUS,
    curve_point,
    fit_curve,
)
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["centres_on_curves", "onto_curves"]

_FEWEST = 5  # points needed for a fit
_MOST = 4096  # points used of a ball
_FITTED = 10  # charts that the curve of a chart is fitted to
_WIDER = 1.2  # times the distance of the furthest of these: its weight must not be zero
_SLIM = TUNING.slim_curve
_BEYOND = 0.25  # spacings beyond the end of a curve; the spacing of charts in a row is two steps


def centres_on_curves(
    points: NDArray[np.float64], places: NDArray[np.float64], spacing: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Move places onto curves through the points around them.

    Args:
        points: ``(M, 3)``, noise around curves.
        places: ``(C, 3)`` between them.
        spacing: ``(C,)`` of the charts there.

    Returns:
        ``(C, 3)``.
    """
    tree = cKDTree(points)
    moved = places.copy()
    radius = TUNING.curve_ball * spacing
    work, out = np.zeros((6, 3)), np.empty(CURVE)
    for row, place in enumerate(places):
        # One by one, since the balls of a dense cloud together hold it many times.
        near = tree.query_ball_point(place, radius[row], return_sorted=True)
        if len(near) >= _FEWEST:
            near = near[:: -(-len(near) // _MOST)]
            local = (points[near] - place).T / radius[row]
            fit_curve(np.ascontiguousarray(local), np.empty(len(near)), work, out)
            foot = curve_point(out, 0.0, 0.0, 0.0, -1.0, 1.0)
            moved[row] += np.asarray(foot) * radius[row]
    return moved


def onto_curves(
    points: NDArray[np.float64],
    nearest: NDArray[np.int32],
    charts: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    on_curve: NDArray[np.bool_],
    spacing: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Move output points onto the curve through the charts around, where these lie on one.

    Args:
        points: ``(K, 3)``.
        nearest: ``(K,)`` int32 nearest chart of each.
        charts: ``(M, 3)`` points of the charts.
        neighbours: ``(M, k)`` charts near each chart, nearest first.
        on_curve: ``(M,)`` charts on a curve.
        spacing: ``(M,)`` of the charts.

    Returns:
        ``(K, 3)``; points beside other charts stay.
    """
    moved = points.copy()
    rows = np.flatnonzero(on_curve[nearest])
    if len(rows):
        rows = rows[np.argsort(nearest[rows], kind="stable")]
        _move(rows, nearest, charts, neighbours, on_curve, spacing, moved)
    return moved


@njit(cache=True, nogil=True)
def _move(rows, nearest, charts, neighbours, on_curve, spacing, moved):  # type: ignore[no-untyped-def]
    """Move the points ``rows``, which are sorted by chart."""
    local, weights = np.empty((3, _FITTED + 1)), np.empty(_FITTED + 1)
    work, out = np.zeros((6, 3)), np.empty(CURVE)
    start = 0
    while start < len(rows):
        chart = nearest[rows[start]]
        stop = start
        while stop < len(rows) and nearest[rows[stop]] == chart:
            stop += 1
        count, radius = 1, 0.0
        local[:, 0] = 0.0
        for at in range(neighbours.shape[1]):
            other = neighbours[chart, at]
            if count <= _FITTED and other != chart and on_curve[other]:
                squared = 0.0
                for a in range(3):
                    local[a, count] = charts[other, a] - charts[chart, a]
                    squared += local[a, count] ** 2
                radius = max(radius, _WIDER * np.sqrt(squared))
                count += 1
        if count >= _FEWEST and radius > 0.0:
            some = local[:, :count] / radius
            fit_curve(some, weights, work, out)
            low = high = 0.0
            for j in range(count):
                s = 0.0
                for a in range(3):
                    s += (some[a, j] - out[ORIGIN + a]) * out[a]
                low, high = min(low, s), max(high, s)
            more = _BEYOND * spacing[chart] / radius
            # Where curves cross, no single one passes through the charts.
            if out[RADIUS] <= _SLIM * out[LENGTH]:
                for at in range(start, stop):
                    i = rows[at]
                    x = (moved[i, 0] - charts[chart, 0]) / radius
                    y = (moved[i, 1] - charts[chart, 1]) / radius
                    z = (moved[i, 2] - charts[chart, 2]) / radius
                    x, y, z = curve_point(out, x, y, z, low - more, high + more)
                    moved[i, 0] = charts[chart, 0] + x * radius
                    moved[i, 1] = charts[chart, 1] + y * radius
                    moved[i, 2] = charts[chart, 2] + z * radius
        start = stop
