# SPDX-License-Identifier: Apache-2.0
"""The input points behind the charts of a redundant scan.

On a clean and even scan each point has its own chart. If a chart represents several points, these
points are kept beside it: attributes come from them, and they are kept or moved onto the surface.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.centres import Centres, choose_centres
from pugeo_model.geometry.flat_noise import is_flat_noise
from pugeo_model.geometry.neighbours import (
    NEIGHBOURS,
    SPACING_NEIGHBOURS,
    knn,
    nearest,
    spacing,
)
from pugeo_model.geometry.partition import partition
from pugeo_model.geometry.quadric_at_points import is_stacked, quadrics_at
from pugeo_model.geometry.regions import nested_regions, usual_regions
from pugeo_model.geometry.scale import least_surface_spacing, measure_scale
from pugeo_model.geometry.strays import stray_points
from pugeo_model.tuning import TUNING

__all__ = ["InputPoints", "TileInput", "represent"]

_FEWEST = 64  # points of a cloud below which nothing tells noise and stray points from detail
_FEWEST_CHARTS = 32  # charts without which a neighbourhood is not complete
_SAMPLE = 16_384  # points of a large cloud that are tested
_GROUP = 64  # tested points, next to each other, that are judged together
_FEW_GROUPS = 0.02  # share of groups that may be rough by chance


@dataclass(frozen=True, eq=False)
class TileInput:
    """The input points behind the charts of a tile.

    Attributes:
        cloud: the points with their attributes.
        points: ``(n, 3)`` float64, unit scale.
        chart: ``(n,)`` int32 row of the tile that represents each.
        core: number of leading points that charts of the core represent.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    chart: NDArray[np.int32]
    core: int


@dataclass(frozen=True, eq=False)
class InputPoints:
    """The input points behind all charts of a cloud.

    Attributes:
        points: ``(M, 3)`` of the cleaned cloud, unit scale.
        centres: the points of the charts.
        stray: ``(M,)`` bool, stray points, which no chart represents.
        curve: ``(M,)`` bool, points on a curve, where no scale shows a surface.
        start, order: rows sorted by chart: ``order[start[c] : start[c + 1]]`` belong to ``c``.
    """

    points: NDArray[np.float64]
    centres: Centres
    stray: NDArray[np.bool_]
    curve: NDArray[np.bool_]
    start: NDArray[np.int64]
    order: NDArray[np.int32]

    def of_charts(self, rows: NDArray[np.int32], core: int, cloud: Cloud) -> TileInput:
        """Return the points behind charts ``rows``, of which ``core`` lead."""
        mine, chart = self.behind(rows)
        inside = int(np.searchsorted(chart, core))
        return TileInput(cloud.take(mine), self.points[mine], chart, inside)

    def behind(self, rows: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return rows of the points behind charts ``rows``, and the index of each one's chart."""
        count = self.start[rows + 1] - self.start[rows]
        chart = np.repeat(np.arange(len(rows), dtype=np.int32), count)
        before = np.cumsum(count) - count
        at = np.arange(len(chart)) - before[chart] + self.start[rows][chart]
        return self.order[at], chart

    def sums_of_charts(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Sum vectors ``(M, 3)`` of the input points over each chart, ``(C, 3)``."""
        rows, charts = self.order, np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        sums = [np.bincount(charts, column, len(self.start) - 1) for column in values[rows].T]
        return np.stack(sums, axis=1).astype(np.float32)


def represent(points: NDArray[np.float64], *, keep_all: bool) -> InputPoints | None:
    """Choose the charts that represent the points; ``None`` if each point has its own.

    Args:
        points: ``(M, 3)``, longest side 1.
        keep_all: all points are part of the output, so none is left out as stray.
    """
    if len(points) < _FEWEST or _is_plain(points):
        return None
    distances, neighbours = nearest(points)
    scale = measure_scale(points, neighbours, distances)
    stray = np.zeros(len(points), np.bool_)
    if not keep_all:
        own = spacing(distances).astype(np.float64)
        around = np.median(own[neighbours[:, :SPACING_NEIGHBOURS]], axis=1)
        stray = stray_points(np.arange(len(points)), points, neighbours, own, around)
    if not (scale.coarse.any() or scale.curve.any() or stray.any()):
        return None
    centres = choose_centres(points, scale, stray)
    if len(centres.points) < _FEWEST_CHARTS:
        return None
    kept = np.flatnonzero(~stray).astype(np.int32)
    order = kept[np.argsort(centres.of_point[kept], kind="stable")]
    start = np.zeros(len(centres.points) + 1, dtype=np.int64)
    np.cumsum(centres.count, out=start[1:])
    return InputPoints(points, centres, stray, scale.curve & ~stray, start, order)


def _is_plain(points: NDArray[np.float64]) -> bool:
    """Return whether a sample shows neither noise, lines, a noisy lattice nor stray points.

    This takes a small part of the time that `measure_scale` takes at every point.
    """
    tree = cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)
    step = -(-len(points) // _SAMPLE)
    groups = partition(points, _GROUP * step)
    rows = np.concatenate([group[::step] for group in groups]).astype(np.intp)
    distances, found = knn(tree, points[rows], min(NEIGHBOURS + 1, len(points)))
    neighbours = found[:, 1:].astype(np.int32)
    near = quadrics_at(rows, points, neighbours, distances[:, 1:].astype(np.float32))
    ends = np.cumsum([0] + [len(group[::step]) for group in groups])
    suspicious, usual = 0, np.empty(len(rows))
    for start, stop in itertools.pairwise(ends):
        part = slice(start, stop)
        usual[part] = np.median(near.spacing[part])
        noisy = np.quantile(near.thickness[part], 0.2) > TUNING.averaged_noise
        lines = np.median(near.flatness[part]) < TUNING.surface_spread
        lattice = (
            np.median(near.order[part]) > TUNING.lattice_order - 0.1 or is_stacked(near, part)
        ) and np.median(near.thickness[part]) > TUNING.lattice_noise
        suspicious += int(noisy or lines or lattice)
    if suspicious > _FEW_GROUPS * len(groups):
        return False
    sample = points[rows]
    regions = nested_regions(sample)
    apart = least_surface_spacing(sample, near, regions) > 0.0
    apart |= is_flat_noise(sample, near, usual_regions(regions))
    if apart.mean() > _FEW_GROUPS:
        return False
    return not stray_points(rows, points, neighbours, near.spacing, usual).any()
