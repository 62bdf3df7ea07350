# SPDX-License-Identifier: Apache-2.0
"""Search of the scale at which points are a surface, or a curve."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.curve_fit import CURVE, KURTOSIS, LENGTH, RADIUS, curve_point, fit_curve
from pugeo_model.geometry.grid import rows_within, sort_into_grid, thinned_grid
from pugeo_model.geometry.robust_quadric import (
    FIT,
    HEIGHT,
    KEPT,
    SPREAD_1,
    SPREAD_2,
    THICKNESS,
    fit_robust_quadric,
)
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["search_curves", "search_surfaces"]

_STEP = np.sqrt(2.0)
_LARGEST_STEPS = 1024.0  # spacings up to which a surface or curve is searched
_FEWEST = 12  # points needed for the fit of a surface
_FEWEST_ON_CURVE = 8  # points needed for the fit of a curve
_PER_CELL = 24  # points used of each half radius of a ball: some 400 of a ball
_BUFFER = 1024  # points of a ball that are used at most
_EXACT = 1e-3  # radii of the ball: noise below which a curve is no pole
_FLAT, _THIN, _BALL = TUNING.surface_spread, TUNING.thin_sheet, TUNING.scale_ball
_TUBE, _SLIM, _POLE = TUNING.tube, TUNING.slim_curve, TUNING.curve_kurtosis


def search_surfaces(
    points: NDArray[np.float64],
    own: NDArray[np.float64],
    wanted: NDArray[np.bool_],
    wide_large: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Search the scale at which the points are a surface, at the wanted points.

    Args:
        points: ``(M, 3)``.
        own: ``(M,)`` spacing from which on a scale is searched.
        wanted: ``(M,)`` points.
        wide_large: least second spread over the first at large scales.

    Returns:
        Spacing of charts ``(M,)``, 0 if none is found, and the noise there ``(M,)``.
    """

    def fit(rows: Any, keys: Any, size: float, grid: Any, found: Any, thickness: Any) -> None:
        wide = _FLAT if size < TUNING.large_scale else wide_large
        _fit_surfaces(points, rows, keys, size, wide, grid, found, thickness)

    return _search(points, own, wanted, fit)


def search_curves(
    points: NDArray[np.float64], own: NDArray[np.float64], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Search the scale at which the points are a curve; see `search_surfaces`."""

    def fit(rows: Any, keys: Any, size: float, grid: Any, found: Any, thickness: Any) -> None:
        _fit_curves(points, rows, keys, size, grid, found, thickness)

    return _search(points, own, wanted, fit)


def _search(
    points: NDArray[np.float64],
    own: NDArray[np.float64],
    wanted: NDArray[np.bool_],
    fit: Callable[..., None],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit at sizes that grow from the spacing on, until two in a row are a surface or curve.

    Args:
        points, own, wanted: as in `search_surfaces`.
        fit: writes spacing and noise of the points of the cells that are a surface or curve; called
            with rows, keys of their cells, size, grid of the balls, and both arrays.
    """
    found, thickness = np.zeros(len(points)), np.zeros(len(points))
    # A scale counts if the next one is a surface too: few points are often thin by chance.
    before, before_thickness = np.zeros(len(points)), np.zeros(len(points))
    left = np.flatnonzero(wanted)
    if not len(left):
        return found, thickness
    size = float(np.quantile(own[left], 0.02)) * _STEP
    while len(left) and size < TUNING.largest_scale:
        active = left[(own[left] * _STEP <= size * 1.01) & (own[left] * _LARGEST_STEPS >= size)]
        if len(active):
            now, now_thickness = np.zeros(len(points)), np.zeros(len(points))
            ball = thinned_grid(points, _BALL * size, _PER_CELL)
            places = sort_into_grid(points[active], size)
            grid = (ball.low, ball.size, ball.keys, ball.order)
            fit(active[places.order].astype(np.int64), places.keys, size, grid, now, now_thickness)
            sure = active[(now[active] > 0.0) & (before[active] > 0.0)]
            found[sure], thickness[sure] = before[sure], before_thickness[sure]
            before[active], before_thickness[active] = now[active], now_thickness[active]
            left = left[found[left] == 0.0]
        size *= _STEP
    return found, thickness


@njit(cache=True, nogil=True)
def _ball_of_cell(start, points, rows, keys, grid, near):  # type: ignore[no-untyped-def]
    """Points around the mean of the cell that begins at ``start``.

    Returns:
        The end of the cell, and the offsets ``(3, n)`` of the points from the mean, in radii.
    """
    low, radius, ball_keys, ball_order = grid
    stop = start
    x = y = z = 0.0
    while stop < len(rows) and keys[stop] == keys[start]:
        x += points[rows[stop], 0]
        y += points[rows[stop], 1]
        z += points[rows[stop], 2]
        stop += 1
    x /= stop - start
    y /= stop - start
    z /= stop - start
    count = rows_within(x, y, z, points, low, radius, ball_keys, ball_order, near)
    local = np.empty((3, count))
    for j in range(count):
        local[0, j] = (points[near[j], 0] - x) / radius
        local[1, j] = (points[near[j], 1] - y) / radius
        local[2, j] = (points[near[j], 2] - z) / radius
    return stop, local


@njit(cache=True, nogil=True)
def _write(start, stop, rows, thick, size, found, thickness):  # type: ignore[no-untyped-def]
    """Write the scale at the points of a cell."""
    for at in range(start, stop):
        found[rows[at]] = min(max(thick / _THIN, size / _STEP), size)
        thickness[rows[at]] = thick


@njit(cache=True, nogil=True)
def _fit_surfaces(points, rows, keys, size, wide, grid, found, thickness):  # type: ignore[no-untyped-def]
    """Fit a quadric around the points of each cell; write the scale where they are a surface."""
    near = np.empty(_BUFFER, dtype=np.int32)
    axes, work, out = np.zeros((3, 3)), np.zeros((8, 6)), np.empty(FIT)
    start = 0
    while start < len(rows):
        stop, local = _ball_of_cell(start, points, rows, keys, grid, near)
        count, radius = local.shape[1], grid[1]
        if count >= _FEWEST:
            weights, heights, flat = np.empty(count), np.empty(count), np.empty(count)
            fit_robust_quadric(local, 1, 0.0, axes, work, weights, heights, flat, out)
            thick = out[THICKNESS] * radius
            # The noise of a wire is as wide in its second direction as in its third.
            surface = out[SPREAD_2] >= wide * out[SPREAD_1]
            surface &= out[THICKNESS] <= _TUBE * out[SPREAD_2]
            thin = thick <= _THIN * size
            belongs = abs(out[HEIGHT]) * radius <= 3.0 * thick + 0.1 * size
            if surface and thin and belongs and out[KEPT] > 0.5:
                _write(start, stop, rows, thick, size, found, thickness)
        start = stop


@njit(cache=True, nogil=True)
def _fit_curves(points, rows, keys, size, grid, found, thickness):  # type: ignore[no-untyped-def]
    """Fit a curve around the points of each cell; write the scale where they are one."""
    near = np.empty(_BUFFER, dtype=np.int32)
    work, out = np.zeros((6, 3)), np.empty(CURVE)
    start = 0
    while start < len(rows):
        stop, local = _ball_of_cell(start, points, rows, keys, grid, near)
        radius = grid[1]
        if local.shape[1] >= _FEWEST_ON_CURVE:
            fit_curve(local, np.empty(local.shape[1]), work, out)
            thick = out[RADIUS] * radius
            slim = out[RADIUS] <= _SLIM * out[LENGTH] and thick <= _THIN * size
            # The surface of a pole is not noise around its axis.
            slim &= out[RADIUS] <= _EXACT or out[KURTOSIS] >= _POLE
            a, b, c = curve_point(out, 0.0, 0.0, 0.0, -1.0, 1.0)
            belongs = np.sqrt(a * a + b * b + c * c) * radius <= 3.0 * thick + 0.1 * size
            if slim and belongs:
                _write(start, stop, rows, thick, size, found, thickness)
        start = stop
