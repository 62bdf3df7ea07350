# SPDX-License-Identifier: Apache-2.0
"""Local scale: the radius around each point within which the points are a surface.

The nearest 32 points are a surface only on a clean and even scan: those of one scan line are a
line, those of stacked frames lie on one ray, and with noise wider than the spacing they fill a
ball. So the radius grows in steps until the points inside are spread in two directions and thin
compared to the radius (Pauly, Keiser and Gross 2003).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.biased_normals import least_unbiased_spacing
from pugeo_model.geometry.depth_steps import find_depth_steps
from pugeo_model.geometry.flat_noise import is_flat_noise
from pugeo_model.geometry.neighbours import knn
from pugeo_model.geometry.partition import partition
from pugeo_model.geometry.quadric_at_points import (
    QuadricsAtPoints,
    are_stacked,
    quadrics_at,
    ranked_neighbour,
)
from pugeo_model.geometry.regions import Regions, nested_regions, usual_regions
from pugeo_model.geometry.scale_search import search_curves, search_surfaces
from pugeo_model.tuning import TUNING

__all__ = ["LocalScale", "least_surface_spacing", "measure_scale"]

_REGION = 2048  # points of a region in which noise is told from detail
_WIDE_REGION = 8192  # points of a region in which noise is about the same
_MOSTLY_NOISY = 0.5  # share of noisy points from which the largest regions are looked at
_LEAST_KNOWN = 0.2  # share of noisy points with a scale, below which it is not propagated
_DONORS = 16  # points with a scale whose median a point without one gets


@dataclass(frozen=True, eq=False)
class LocalScale:
    """Scale and noise around each point.

    Attributes:
        spacing: ``(M,)`` float64 spacing that charts should have: that of the points themselves
            unless ``coarse``; unit scale.
        wanted: ``(M,)`` float64 the same without regard to finer charts nearby.
        radius: ``(M,)`` float64 radius of the ball of points that a chart is fitted to; it follows
            ``wanted``.
        coarse: ``(M,)`` bool, several points are represented by one chart.
        curve: ``(M,)`` bool, no scale shows a surface and some scale shows a curve: a wire, one
            scan line.
        noise: ``(M,)`` float64 standard deviation of the points along the normal, unit scale.
    """

    spacing: NDArray[np.float64]
    wanted: NDArray[np.float64]
    radius: NDArray[np.float64]
    coarse: NDArray[np.bool_]
    curve: NDArray[np.bool_]
    noise: NDArray[np.float64]


def measure_scale(
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    distances: NDArray[np.float32],
) -> LocalScale:
    """Measure the scale at every point.

    Args:
        points: ``(M, 3)``, longest side about 1.
        neighbours, distances: ``(M, k)`` of the nearest points, see `nearest`.
    """
    near = quadrics_at(np.arange(len(points)), points, neighbours, distances)
    noise_level = _regional_noise(points, near.thickness)
    flatness = ranked_neighbour(near.flatness, neighbours, 16)
    # On a lattice, and in stacked frames, a fit to few points does not show the noise.
    lattice = ranked_neighbour(near.order, neighbours, 16) > TUNING.lattice_order
    lattice |= are_stacked(near, neighbours)
    lattice &= ranked_neighbour(near.thickness, neighbours, 4) > TUNING.lattice_noise
    own = near.spacing
    noise = np.minimum(near.thickness, 1.6 * noise_level) * own
    regions = nested_regions(points)
    least = least_surface_spacing(points, near, regions)
    very_noisy = noise_level > _bound_of_noise(noise_level)
    flat = is_flat_noise(points, near, usual_regions(regions))
    flat &= ~very_noisy & (least == 0.0)
    noisy = very_noisy | lattice | flat
    line = flatness < TUNING.surface_spread
    tube = _is_tube(near, regions)
    if very_noisy.mean() > _MOSTLY_NOISY:
        # The denser the cloud, the larger are regions that are longer than their noise is wide.
        tube |= _is_tube(near, nested_regions(points, start=len(regions)))
    coarse = noisy | line | tube | (least > 0.0)
    spacing = own.copy()
    curve = no_scale = np.zeros(len(points), np.bool_)
    if coarse.any():
        searched = coarse & (least == 0.0)
        found, thickness = _surfaces(points, own, searched & (noisy | line), least)
        _propagate_scale(points, (noisy | (least > 0.0)) & (found == 0.0), found, thickness)
        # A neighbourhood that is thin by chance must not remain a single noisy point.
        usual = np.where(noisy, _usual(found, neighbours), found) if noisy.any() else found
        no_surface = searched & (usual == 0.0)
        may_be_curve = no_surface & (line | tube)
        if may_be_curve.any():
            along, across = _curves(points, own, neighbours, may_be_curve, no_surface)
            curve = along > 0.0
        if noisy.any():
            _bound_by_region(points, noisy, usual)
            _bound_by_region(points, noisy, thickness)
            merged = np.where(lattice, TUNING.lattice_merge, TUNING.least_merge) * own
            merged[flat] = TUNING.flat_merge * own[flat]
            found[noisy] = np.maximum(usual, merged)[noisy]
            found = np.where(found > 0.0, np.maximum(found, least), 0.0)
        no_scale = curve | ((noisy | line) & (found == 0.0))
        if curve.any():
            found[curve], thickness[curve] = along[curve], across[curve]
        coarse = coarse & (found > 1.1 * own)
        spacing[coarse] = found[coarse]
        noise[coarse] = thickness[coarse]
    radius = np.maximum(TUNING.chart_ball * spacing, TUNING.least_chart_ball * own)
    graded = _graded(points, own, spacing, coarse, no_scale)
    return LocalScale(graded, spacing, radius, coarse, curve, noise)


def _surfaces(
    points: NDArray[np.float64],
    own: NDArray[np.float64],
    searched: NDArray[np.bool_],
    least: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spacing of charts on surfaces ``(M,)``, 0 where none is found, and the noise there.

    Args:
        points: ``(M, 3)``.
        own: ``(M,)`` spacing of the points.
        searched: ``(M,)`` points where a surface is searched.
        least: ``(M,)`` least spacing of charts in regions that are known to be flat, else 0.
    """
    found, thickness = search_surfaces(points, own, searched, TUNING.round_ball)
    large = found > TUNING.large_scale
    if np.count_nonzero(large) < TUNING.mostly_large * np.count_nonzero(searched):
        # A few such points are thin parts of the shape, which a large ball takes for a sheet.
        found[large] = thickness[large] = 0.0
    if least.any():
        flat_from = np.maximum(own, least)
        more, thick = search_surfaces(points, flat_from, least > 0.0, TUNING.surface_spread)
        found, thickness = found + more, thickness + thick
    return found, thickness


def _is_tube(near: QuadricsAtPoints, regions: list[Regions]) -> NDArray[np.bool_]:
    """Return which points may be noise around a curve: a region is long and rough, ``(M,)``.

    Args:
        near: of the points.
        regions: that contain them.
    """
    tube = np.zeros(len(near.thickness), np.bool_)
    for region in regions:
        slim = region.second <= TUNING.slim_curve * region.first
        slim &= region.third >= 0.5 * region.second
        if slim.any():
            inside = slim[region.of_point]
            level = region.quantiles(near.thickness, TUNING.noise_quantile, inside)
            tube |= inside & (level > TUNING.tube_noise)[region.of_point]
    return tube


def _usual(values: NDArray[np.float64], neighbours: NDArray[np.int32]) -> NDArray[np.float64]:
    """Median of the medians around, ``(M,)``."""
    return ranked_neighbour(ranked_neighbour(values, neighbours, 16), neighbours, 16)


def _curves(
    points: NDArray[np.float64],
    own: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    searched: NDArray[np.bool_],
    no_surface: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spacing of charts on curves ``(M,)``, 0 elsewhere, and the noise across the curves.

    Args:
        points: ``(M, 3)``.
        own: ``(M,)`` spacing of the points.
        neighbours: ``(M, k)``.
        searched: ``(M,)`` points where a curve is searched.
        no_surface: ``(M,)`` points that may belong to one; also single ones beside a curve.
    """
    rows = np.flatnonzero(no_surface)
    along, across = np.zeros(len(points)), np.zeros(len(points))
    # Among these only: a surface beside a wire does not matter, and large clouds have few.
    along[rows], across[rows] = search_curves(points[rows], own[rows], searched[rows])
    for values in (along, across):
        for _ in range(2):
            values[rows] = ranked_neighbour(values, neighbours, 16, rows)
    # Points on the curve represent themselves.
    exact = across <= TUNING.thin_sheet * own
    along[exact] = np.minimum(along, own)[exact]
    return along, across


def _graded(
    points: NDArray[np.float64],
    own: NDArray[np.float64],
    spacing: NDArray[np.float64],
    coarse: NDArray[np.bool_],
    no_scale: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Bound the spacing of charts ``(M,)``, so that it grows slowly away from finer charts.

    A chart reaches as far as its neighbours are apart: a few wide ones among fine ones would leave
    holes between them. Points for which no scale shows a surface do not count.
    """
    graded = spacing.copy()
    bound = TUNING.narrow_charts
    while True:
        wider = coarse & (graded > bound * own)
        finer = ~wider & ~no_scale
        if not wider.any() or not finer.any():
            return graded
        rows, others = np.flatnonzero(wider), np.flatnonzero(finer)
        distances, near = knn(cKDTree(points[others]), points[rows], 1)
        limit = graded[others[near[:, 0]]] + TUNING.grading * distances[:, 0]
        graded[rows] = np.minimum(graded[rows], np.maximum(limit, TUNING.narrow_charts * own[rows]))
        bound *= 2.0


def least_surface_spacing(
    points: NDArray[np.float64], near: QuadricsAtPoints, regions: list[Regions]
) -> NDArray[np.float64]:
    """Least spacing of charts ``(M,)`` where a larger region shows that it is needed, else 0.

    Args:
        points: ``(M, 3)``, unit scale; all points or a sample.
        near: of these points.
        regions: that contain the points, from small to large.
    """
    least = least_unbiased_spacing(near.normal, near.flatness >= TUNING.surface_spread, regions)
    steps = find_depth_steps(points, near, regions)
    if steps is None:
        return least
    stepped = steps.least_spacing(near.spacing, regions)
    return np.where(stepped > 0.0, stepped, least)


def _bound_of_noise(level: NDArray[np.float64]) -> float:
    """Noise level from which charts represent several points.

    It is lower if some region exceeds it, so that a cloud with the same noise everywhere is treated
    alike.
    """
    bound = TUNING.averaged_noise
    return bound * (TUNING.averaged_alike if level.max() > bound else 1.0)


def _regional_noise(
    points: NDArray[np.float64], thickness: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Thickness that nine in ten points of a region exceed, at each point, ``(M,)``.

    Detail leaves residuals at some points, noise at all.
    """
    level = np.empty(len(points))
    for rows in partition(points, _REGION):
        level[rows] = np.quantile(thickness[rows], TUNING.noise_quantile)
    return level


def _bound_by_region(
    points: NDArray[np.float64], noisy: NDArray[np.bool_], values: NDArray[np.float64]
) -> None:
    """Bound values of noisy points by the small values of their region, in place.

    Noise is about the same everywhere in a region. If only a large scale finds a surface, a thin
    part of the shape was mistaken for noise.
    """
    for rows in partition(points, _WIDE_REGION):
        some = rows[noisy[rows] & (values[rows] > 0.0)]
        if len(some):
            small = np.quantile(values[some], TUNING.region_quantile)
            values[some] = np.minimum(values[some], TUNING.region_bound * small)


def _propagate_scale(
    points: NDArray[np.float64],
    lacking: NDArray[np.bool_],
    found: NDArray[np.float64],
    thickness: NDArray[np.float64],
) -> None:
    """Give noisy points without a scale, where detail hides it, that of the points around."""
    known, rows = np.flatnonzero(found > 0.0), np.flatnonzero(lacking)
    # Few points are thin by chance: those of a volume have no scale.
    if not len(rows) or len(known) < _LEAST_KNOWN * (len(known) + len(rows)):
        return
    near = known[knn(cKDTree(points[known]), points[rows], min(_DONORS, len(known)))[1]]
    found[rows] = np.median(found[near], axis=1)
    thickness[rows] = np.median(thickness[near], axis=1)
