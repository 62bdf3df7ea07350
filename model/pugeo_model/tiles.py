# SPDX-License-Identifier: Apache-2.0
"""Division of a large cloud into tiles, so that memory stays bounded and time grows linearly.

A tile is a compact part of the cloud, its core, with a margin of the surrounding points that
influence the core. Tiles are processed independently, and only the points of the core are kept.
A small cloud is one tile without a margin.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.aabb import bounds, rows_inside
from pugeo_model.geometry.frames import noise_level, rough_residuals
from pugeo_model.geometry.neighbours import NEIGHBOURS, SPACING_NEIGHBOURS, knn, spacing
from pugeo_model.geometry.partition import PATCH_SIZE, partition
from pugeo_model.input_points import TileInput
from pugeo_model.normalise import Normalisation
from pugeo_model.tuning import TUNING

__all__ = ["NoisyInput", "Tile", "TileSpec", "plan_tiles"]

_POINTS_OUT = 3 << 16  # output points of a core, which bound the memory of a worker
_FEWEST, _MOST = 1 << 14, 1 << 16  # input points of a core; up to 1/4 more to save a tile
_WHOLE = 1.5  # cores: a cloud up to this size is one tile, since margins would cost more
_DENSER = 0.7  # times the spacing of a core: a denser neighbour bounds the margin
_KEPT_TREES = 64
_SPACING_SAMPLES = 512  # points of a core from which the width of its margin is estimated


@dataclass(frozen=True, eq=False)
class TileSpec:
    """The rows of a tile.

    Attributes:
        rows: ``(n,)`` int32 rows of the cloud: the core, the inner margin, the outer margin.
        core: number of leading rows in the core.
        charted: number of leading rows that get charts: core and inner margin.
        n_out: number of output points of the tile.
    """

    rows: NDArray[np.int32]
    core: int
    charted: int
    n_out: int

    @property
    def patches(self) -> int:
        """Number of patches of the tile."""
        return -(-self.charted // PATCH_SIZE)


@dataclass(frozen=True)
class NoisyInput:
    """Measurements of a noisy input before denoising.

    Attributes:
        noise: in spacings, see `noise_level`.
        median_spacing: float32, unit scale.
        moved: median distance by which denoising moved the points, in spacings.
    """

    noise: float
    median_spacing: np.floating[Any]
    moved: float


@dataclass(frozen=True, eq=False)
class Tile:
    """Part of a cloud with all data that its upsampling needs.

    Attributes:
        cloud: the input points: the core, the inner margin, the outer margin. If charts represent
            several points, those are in ``input`` and this is their cloud.
        points: ``(n, 3)`` float64 points of charts, in the unit scale of the whole cloud.
        rows: ``(n,)`` int32, rows in the cleaned cloud.
        core: number of leading points in the core; cores partition the cloud.
        charted: number of leading points that get charts.
        n_out: number of output points of the tile.
        candidates: candidates per chart.
        keeps_input: whether the points of the core are part of the output, in their order.
        moves_input: whether these are moved onto the surface.
        noise: of the whole cloud, in spacings, see `noise_level`; ``None`` if the tile measures
            it itself: it is the whole cloud, or was denoised.
        spacing: median spacing of the whole cloud, unit scale; ``None`` if the tile is the whole.
        normalisation: map between the cloud's own frame and the unit frame.
        orient: method that gives normals their signs, never ``auto``.
        viewpoint: ``(x, y, z)`` in the cloud's own frame and units, if there is one only.
        sights: ``(n, 3)`` float32 directions from the charts to the stations that saw them, if
            there are several.
        centroid: ``(3,)`` float64, of the whole cloud, unit scale.
        seed: seed of the sample.
        noisy: measurements of the original input, if ``points`` were denoised.
        patch_ratio: R of a network that upsamples whole patches, ``None`` if charts are predicted.
        is_even: whether the output has one spacing over the whole surface.
        max_gap: largest distance of an output point from the input, unit scale.
        confidence: whether the output has the expected error of each point.
        input: the input points behind the charts; ``None`` if each point has its own chart.
        weights: ``(n,)`` float64 to which the numbers of output points of charts are
            proportional, see `Plan`; ``None`` if all are equal.
        usual_weight: weight of the usual chart of the whole cloud.
        on_curve: ``(n,)`` bool, charts on a wire or single scan line; ``None`` if there are none.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    rows: NDArray[np.int32]
    core: int
    charted: int
    n_out: int
    candidates: int
    keeps_input: bool
    moves_input: bool
    noise: float | None
    spacing: float | None
    normalisation: Normalisation
    orient: str
    viewpoint: tuple[float, float, float] | None
    sights: NDArray[np.float32] | None
    centroid: NDArray[np.float64]
    seed: int
    noisy: NoisyInput | None = None
    patch_ratio: int | None = None
    is_even: bool = False
    max_gap: float | None = None
    confidence: bool = False
    input: TileInput | None = None
    weights: NDArray[np.float64] | None = None
    usual_weight: float = 1.0
    on_curve: NDArray[np.bool_] | None = None

    @property
    def kept(self) -> int:
        """Number of input points in the core, which lead the output if it keeps them."""
        return self.core if self.input is None else self.input.core

    @property
    def unmoved(self) -> int:
        """Number of leading output points that are input points where they were."""
        return self.kept if self.keeps_input and not self.moves_input else 0


def plan_tiles(
    points: NDArray[np.float64],
    n_out: int,
    size: int | None = None,
    weights: NDArray[np.float64] | None = None,
    kept: NDArray[np.integer[Any]] | None = None,
) -> tuple[list[TileSpec], float | None, float | None]:
    """Divide a cloud into tiles.

    Args:
        points: ``(M, 3)`` float64.
        n_out: number of output points, divided among the tiles in proportion to their cores.
        size: largest number of input points in a core; by default it follows from ``n_out``.
        weights: ``(M,)`` to which the output points of a tile are proportional, by default equal.
        kept: ``(M,)`` output points that each point brings along as they are: a tile has at least
            these. By default none.

    Returns:
        The tiles, whose cores partition the cloud; noise and median spacing of the cloud, see
        :class:`Tile`, both ``None`` for a single tile, which measures them itself.
    """
    count = len(points)
    if size is None:
        size = min(max(_POINTS_OUT * count // n_out, _FEWEST), _MOST)
        size = max(size, -(-count // max(1, round(count / size))))
    if count <= _WHOLE * size:
        return [TileSpec(np.arange(count, dtype=np.int32), count, count, n_out)], None, None
    cores = partition(points, size)
    margins = _margins(points, cores)
    ends = _output_ends(cores, n_out, weights, kept)
    specs = [
        TileSpec(
            np.concatenate([core, *margin]), len(core), len(core) + len(margin[0]), stop - start
        )
        for core, margin, (start, stop) in zip(
            cores, margins, itertools.pairwise(ends), strict=True
        )
    ]
    return specs, *_noise_and_spacing(points, specs[:: -(-len(specs) // TUNING.noise_tiles)])


def _output_ends(
    cores: list[NDArray[np.int32]],
    n_out: int,
    weights: NDArray[np.float64] | None,
    kept: NDArray[np.integer[Any]] | None,
) -> list[int]:
    """Index of the first output point of each tile, and ``n_out``."""
    if weights is None:
        sizes = np.cumsum([0] + [len(core) for core in cores]).tolist()
        return [n_out * at // sizes[-1] for at in sizes]
    parts = np.array([float(weights[core].sum()) for core in cores])
    parts *= n_out / parts.sum()
    if kept is not None:
        # Points that are kept count first; the rest goes where the share of a tile is larger.
        least = np.array([int(kept[core].sum()) for core in cores])
        more = np.maximum(parts - least, 0.0)
        extra = n_out - int(least.sum())
        new = np.rint(np.cumsum(more) * (extra / max(float(more.sum()), 1e-300))).astype(np.int64)
        return [0, *(np.cumsum(least) + new).tolist()]
    ends: list[int] = np.rint(np.cumsum(parts)).astype(np.int64).tolist()
    return [0, *ends]


def _margins(
    points: NDArray[np.float64], cores: list[NDArray[np.int32]]
) -> list[tuple[NDArray[np.int32], NDArray[np.int32]]]:
    """Rows of the inner and the outer margin of each core.

    The width of a margin is ``TUNING.margin`` times the spacing of the core. In a denser
    neighbouring tile it follows the spacing of that tile: otherwise a coarse tile would contain
    all of it.
    """
    boxes = np.array([bounds(points, core) for core in cores])
    low, high = boxes[:, 0], boxes[:, 1]
    trees = _Trees(points, cores)
    spacings = [_spacing_quantile(trees[tile]) for tile in range(len(cores))]
    margins = []
    for tile in range(len(cores)):
        width = TUNING.margin * spacings[tile]
        # A box test first: points inside the widened box, of the tiles whose boxes overlap it.
        wide_low, wide_high = low[tile] - width, high[tile] + width
        overlaps = ((low <= wide_high) & (high >= wide_low)).all(axis=1)
        overlaps[tile] = False
        inner, outer = [np.empty(0, dtype=np.int32)], [np.empty(0, dtype=np.int32)]
        for other in np.flatnonzero(overlaps).tolist():
            rows = rows_inside(points, cores[other], wide_low, wide_high)
            found = trees[tile].query(points[rows], distance_upper_bound=width)
            distance, nearest = np.asarray(found[0]), np.asarray(found[1])
            near = np.isfinite(distance)
            rows, nearest, distance = rows[near], nearest[near], distance[near]
            charted = np.full(len(rows), TUNING.charted_margin * spacings[tile])
            if spacings[other] < _DENSER * spacings[tile] and len(rows):
                # Depth is measured from the neighbour's point nearest to the core point.
                met, where = np.unique(nearest, return_inverse=True)
                first = np.asarray(trees[other].query(trees[tile].data[met])[0])[where]
                deep = distance < first + TUNING.margin * spacings[other]
                rows, distance, first = rows[deep], distance[deep], first[deep]
                least = first + TUNING.charted_margin * spacings[other]
                charted = np.minimum(charted[deep], least)
            near = distance < charted
            inner.append(rows[near])
            outer.append(rows[~near])
        margins.append((np.concatenate(inner), np.concatenate(outer)))
    return margins


class _Trees:
    """Trees of the cores, of which a few are kept: neighbours in space are mostly so in order.

    Args:
        points: ``(M, 3)``.
        cores: rows of each core.
    """

    def __init__(self, points: NDArray[np.float64], cores: list[NDArray[np.int32]]) -> None:
        self._points, self._cores = points, cores
        self._made: dict[int, cKDTree] = {}

    def __getitem__(self, core: int) -> cKDTree:
        """Return the tree of a core."""
        if core not in self._made:
            if len(self._made) >= _KEPT_TREES:
                del self._made[next(iter(self._made))]
            # These settings halve the time to build the tree and hardly slow down few queries.
            self._made[core] = cKDTree(
                self._points[self._cores[core]],
                leafsize=32,
                balanced_tree=False,
                compact_nodes=False,
            )
        return self._made[core]


def _spacing_quantile(tree: cKDTree) -> float:
    """The 90 % quantile of the spacings of the points of a tree, from a sample."""
    sample = tree.data[:: max(1, tree.n // _SPACING_SAMPLES)]
    distances, _ = knn(tree, sample, SPACING_NEIGHBOURS + 1)
    return float(np.quantile(distances[:, 1:].mean(axis=1), TUNING.margin_quantile))


def _noise_and_spacing(points: NDArray[np.float64], specs: list[TileSpec]) -> tuple[float, float]:
    """Noise and median spacing of a cloud, from points of some tiles."""
    residuals, spacings = [], []
    for spec in specs:
        tile = points[spec.rows]
        sample = np.arange(0, spec.core, max(1, spec.core // TUNING.noise_points))
        distances, rows = knn(cKDTree(tile), tile[sample], NEIGHBOURS + 1)
        # `rough_residuals` treats the leading rows, so a copy of the sampled points leads.
        near = (rows[:, 1:] + len(sample)).astype(np.int32)
        stacked = np.concatenate([tile[sample], tile])
        spacings.append(spacing(distances[:, 1:].astype(np.float32)))
        residuals.append(rough_residuals(stacked, near, spacings[-1]))
    return noise_level(np.concatenate(residuals)), float(np.median(np.concatenate(spacings)))
