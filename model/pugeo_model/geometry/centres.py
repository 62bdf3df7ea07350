# SPDX-License-Identifier: Apache-2.0
"""Chart centres: an even subset of a redundant scan, moved onto the surface through all points.

If single points say little about the surface (noise wider than the spacing, scan lines, stacked
frames), one centre represents many points. Each centre is moved onto a robust quadric through all
points around it; a plain mean would shrink curved parts and follow stray points.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.curves import centres_on_curves
from pugeo_model.geometry.grid import rows_within, sort_into_grid, thinned_grid
from pugeo_model.geometry.neighbours import knn
from pugeo_model.geometry.robust_quadric import (
    FIT,
    FOOT,
    KEPT,
    SPREAD_1,
    SPREAD_2,
    THICKNESS,
    fit_robust_quadric,
)
from pugeo_model.geometry.scale import LocalScale
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["Centres", "choose_centres"]

_COMPARED_PLACES = 24  # places around a place that are compared
_LLOYD_ROUNDS = 2
_LARGEST_OFFSET = 0.5  # spacings of the centres from a centre to the nearest point
_ROBUST_ROUNDS = 2
_PER_CELL = 64  # points used of each half radius of a ball: some 1,000 of a ball
_BUFFER = 2048  # points of a ball that are used at most
_FEWEST = 8  # points needed for a fit
_SMALLER, _SIZES = 0.7, 3  # factor of the next ball if a fit fails, and number of balls
_FLAT = TUNING.surface_spread
_UNDERESTIMATED = 1.3  # noise that fits to few points miss
_THICKER = 1.6  # times the noise around: a thicker fit covers two surfaces


@dataclass(frozen=True, eq=False)
class Centres:
    """Centres of charts.

    Attributes:
        points: ``(C, 3)`` float64; points that represent only themselves lead, in order.
        of_point: ``(M,)`` int32 centre that represents each input point, or the nearest.
        count: ``(C,)`` int32 number of points that each represents.
        on_curve: ``(C,)`` bool, centres on a curve, where no scale shows a surface.
    """

    points: NDArray[np.float64]
    of_point: NDArray[np.int32]
    count: NDArray[np.int32]
    on_curve: NDArray[np.bool_]


def choose_centres(
    points: NDArray[np.float64], scale: LocalScale, left_out: NDArray[np.bool_]
) -> Centres:
    """Choose the centres of the charts.

    Args:
        points: ``(M, 3)`` float64, unit scale.
        scale: of the points.
        left_out: ``(M,)`` points without a centre of their own: stray points.
    """
    coarse = scale.coarse & ~left_out
    single = np.flatnonzero(~scale.coarse & ~left_out)
    surfaces = _of_surfaces(points, scale, np.flatnonzero(coarse & ~scale.curve))
    curves = _of_curves(points, scale, np.flatnonzero(coarse & scale.curve))
    centres = np.concatenate([points[single], surfaces, curves])
    on_curve = np.zeros(len(centres), np.bool_)
    on_curve[: len(single)] = scale.curve[single]
    on_curve[len(single) + len(surfaces) :] = True
    of_point = np.empty(len(points), dtype=np.int32)
    of_point[single] = np.arange(len(single))
    rest = np.flatnonzero(scale.coarse | left_out)
    # The nearest centre may also be one of the single points.
    of_point[rest] = knn(cKDTree(centres), points[rest], 1)[1][:, 0]
    represented = np.bincount(of_point[~left_out], minlength=len(centres)).astype(np.int32)
    return Centres(centres, of_point, represented, on_curve)


def _of_surfaces(
    points: NDArray[np.float64], scale: LocalScale, rows: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Centres of the points ``rows``, which are a surface, ``(C, 3)``."""
    if not len(rows):
        return points[:0]
    places, _, wanted, radius, noise = _even_places(points, scale, rows)
    return _bounded(points, _project(points, places, radius, noise), wanted)


def _of_curves(
    points: NDArray[np.float64], scale: LocalScale, rows: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Centres of the points ``rows``, which lie around curves, ``(C, 3)``."""
    if not len(rows):
        return points[:0]
    places, spacing, *_ = _even_places(points, scale, rows)
    return centres_on_curves(points[rows], places, spacing)


def _even_places(
    points: NDArray[np.float64], scale: LocalScale, rows: NDArray[np.intp]
) -> tuple[NDArray[np.float64], ...]:
    """Evenly spaced places among the points ``rows``, ``(C, 3)``, and the scale at each.

    Returns:
        The places; of each ``spacing``, ``wanted``, ``radius`` and ``noise``, see `LocalScale`.
    """
    places, spacing, wanted, radius, noise, count = _cell_means(points, scale, rows)
    chosen = _spaced_apart(places, spacing, count)
    scales = (value[chosen] for value in (spacing, wanted, radius, noise))
    return _lloyd(places[chosen], places), *scales


def _cell_means(
    points: NDArray[np.float64], scale: LocalScale, rows: NDArray[np.intp]
) -> tuple[NDArray[np.float64], ...]:
    """Means over the points of small cells: places, and the scale there; and their number."""
    spacing = scale.spacing[rows]
    least = float(spacing.min())
    parts = []
    level = np.ceil(2.0 * np.log2(spacing / least))
    for step in np.unique(level):
        some = rows[level == step]
        grid = sort_into_grid(points[some], least * 2.0 ** (float(step) / 2.0) / 2.0)
        some = some[grid.order]
        starts = np.flatnonzero(np.append(True, grid.keys[1:] != grid.keys[:-1]))
        count = np.diff(np.append(starts, len(some)))
        values = (scale.spacing, scale.wanted, scale.radius, scale.noise)
        means = [np.add.reduceat(value[some], starts) / count for value in values]
        places = np.add.reduceat(points[some], starts) / count[:, None]
        parts.append((places, *means, count))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def _spaced_apart(
    places: NDArray[np.float64], spacing: NDArray[np.float64], count: NDArray[Any]
) -> NDArray[np.intp]:
    """Greedy subset of places with a least distance; places of many points are taken first."""
    near = min(_COMPARED_PLACES, len(places))
    distances, rows = knn(
        cKDTree(places), places, near, TUNING.centre_distance * float(spacing.max())
    )
    order = np.lexsort((np.arange(len(places)), -count))
    return np.flatnonzero(_greedy(order, distances, rows, TUNING.centre_distance * spacing))


@njit(cache=True, nogil=True)
def _greedy(order, distances, rows, least):  # type: ignore[no-untyped-def]
    """Take places in order, unless one within the least distance was taken."""
    free, taken = np.ones(len(order), np.bool_), np.zeros(len(order), np.bool_)
    for i in order:
        if not free[i]:
            continue
        taken[i] = True
        for at in range(rows.shape[1]):
            j = rows[i, at]
            if j < len(order) and distances[i, at] < least[i]:
                free[j] = False
    return taken


def _lloyd(centres: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move centres to the means of the places nearest to them (Lloyd 1982)."""
    for _ in range(_LLOYD_ROUNDS):
        owner = knn(cKDTree(centres), places, 1)[1][:, 0]
        members = np.bincount(owner, minlength=len(centres))
        sums = [np.bincount(owner, places[:, axis], len(centres)) for axis in range(3)]
        means = np.stack(sums, axis=1) / np.maximum(members, 1)[:, None]
        centres = np.where(members[:, None] > 0, means, centres)
    return centres


def _project(
    points: NDArray[np.float64],
    places: NDArray[np.float64],
    radius: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Project places ``(C, 3)`` onto robust quadrics through the points around them."""
    moved = places.copy()
    level = np.ceil(2.0 * np.log2(radius / radius.min()))
    for step in np.unique(level):
        some = np.flatnonzero(level == step)
        # Slightly larger cells, so that rounding does not exclude points at the radius.
        size = float(radius.min() * 2.0 ** (float(step) / 2.0)) * (1.0 + 1e-9)
        ball = thinned_grid(points, size, _PER_CELL)
        grid = (ball.low, ball.size, ball.keys, ball.order)
        _project_some(points, places, some, radius, noise, grid, moved)
    return moved


def _bounded(
    points: NDArray[np.float64], centres: NDArray[np.float64], spacing: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Replace centres that moved away from all points by the nearest point."""
    distances, rows = knn(cKDTree(points), centres, 1)
    away = distances[:, 0] > _LARGEST_OFFSET * spacing
    return np.where(away[:, None], points[rows[:, 0]], centres)


@njit(cache=True, nogil=True)
def _project_some(points, places, some, radii, noise, grid, moved):  # type: ignore[no-untyped-def]
    """Project some of the places, twice each; writes ``moved``."""
    low, size, keys, order = grid
    near = np.empty(_BUFFER, dtype=np.int32)
    axes, work, out = np.zeros((3, 3)), np.zeros((8, 6)), np.empty(FIT)
    for i in some:
        x, y, z = places[i, 0], places[i, 1], places[i, 2]
        for _ in range(2):
            found = rows_within(x, y, z, points, low, size, keys, order, near)
            radius = radii[i]
            # Where the ball covers more than one surface, a smaller one may not.
            for _ in range(_SIZES):
                local = np.empty((3, found))
                count = 0
                for j in range(found):
                    a = (points[near[j], 0] - x) / radius
                    b = (points[near[j], 1] - y) / radius
                    c = (points[near[j], 2] - z) / radius
                    if a * a + b * b + c * c < 1.0:
                        local[0, count], local[1, count], local[2, count] = a, b, c
                        count += 1
                if count < _FEWEST:
                    break
                weights, heights, ball = np.empty(count), np.empty(count), np.empty(count)
                fit_robust_quadric(
                    local[:, :count].copy(),
                    _ROBUST_ROUNDS,
                    _UNDERESTIMATED * noise[i] / radius,
                    axes,
                    work,
                    weights,
                    heights,
                    ball,
                    out,
                )
                sound = out[SPREAD_2] >= _FLAT * out[SPREAD_1] and out[KEPT] > 0.3
                if sound and out[THICKNESS] * radius <= _THICKER * noise[i] + 0.02 * radius:
                    break
                radius *= _SMALLER
            if count < _FEWEST:
                break
            shift = np.sqrt(out[FOOT] ** 2 + out[FOOT + 1] ** 2 + out[FOOT + 2] ** 2)
            shrink = min(1.0, 0.5 / max(shift, 1e-12)) * radius
            x += out[FOOT] * shrink
            y += out[FOOT + 1] * shrink
            z += out[FOOT + 2] * shrink
        moved[i, 0], moved[i, 1], moved[i, 2] = x, y, z
