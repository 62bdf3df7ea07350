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
from pugeo_model.normalise import Normalisation
from pugeo_model.tuning import TUNING

__all__ = ["NoisyInput", "Tile", "TileSpec", "plan_tiles"]

_POINTS_OUT = 3 << 16  # output points of a core, which bound the memory of a worker
_FEWEST, _MOST = 1 << 14, 1 << 16  # input points of a core; up to 1/4 more to save a tile
_WHOLE = 1.5  # cores: a cloud up to this size is one tile, since margins would cost more
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
    """

    noise: float
    median_spacing: np.floating[Any]


@dataclass(frozen=True, eq=False)
class Tile:
    """Part of a cloud with all data that its upsampling needs.

    Attributes:
        cloud: the input points: the core, the inner margin, the outer margin.
        points: ``(n, 3)`` float64, in the unit scale of the whole cloud.
        rows: ``(n,)`` int32, rows in the cleaned cloud.
        core: number of leading points in the core; cores partition the cloud.
        charted: number of leading points that get charts.
        n_out: number of output points of the tile.
        candidates: candidates per chart.
        keeps_input: whether the points of the core are part of the output, unchanged.
        noise: of the whole cloud, in spacings, see `noise_level`; ``None`` if the tile measures
            it itself: it is the whole cloud, or was denoised.
        spacing: median spacing of the whole cloud, unit scale; ``None`` if the tile is the whole.
        normalisation: map between the cloud's own frame and the unit frame.
        orient: method that gives normals their signs, never ``auto``.
        viewpoint: ``(x, y, z)`` in the cloud's own frame and units.
        centroid: ``(3,)`` float64, of the whole cloud, unit scale.
        seed: seed of the sample.
        noisy: measurements of the original input, if ``points`` were denoised.
        patch_ratio: R of a network that upsamples whole patches, ``None`` if charts are predicted.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    rows: NDArray[np.int32]
    core: int
    charted: int
    n_out: int
    candidates: int
    keeps_input: bool
    noise: float | None
    spacing: float | None
    normalisation: Normalisation
    orient: str
    viewpoint: tuple[float, float, float] | None
    centroid: NDArray[np.float64]
    seed: int
    noisy: NoisyInput | None = None
    patch_ratio: int | None = None


def plan_tiles(
    points: NDArray[np.float64], n_out: int, size: int | None = None
) -> tuple[list[TileSpec], float | None, float | None]:
    """Divide a cloud into tiles.

    Args:
        points: ``(M, 3)`` float64.
        n_out: number of output points, divided among the tiles in proportion to their cores.
        size: largest number of input points in a core; by default it follows from ``n_out``.

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
    ends = [n_out * at // count for at in np.cumsum([0] + [len(core) for core in cores]).tolist()]
    specs = [
        TileSpec(
            np.concatenate([core, *margin]), len(core), len(core) + len(margin[0]), stop - start
        )
        for core, margin, (start, stop) in zip(
            cores, margins, itertools.pairwise(ends), strict=True
        )
    ]
    return specs, *_noise_and_spacing(points, specs[:: -(-len(specs) // TUNING.noise_tiles)])


def _margins(
    points: NDArray[np.float64], cores: list[NDArray[np.int32]]
) -> list[tuple[NDArray[np.int32], NDArray[np.int32]]]:
    """Rows of the inner and the outer margin of each core."""
    boxes = np.array([bounds(points, core) for core in cores])
    low, high = boxes[:, 0], boxes[:, 1]
    margins = []
    for tile, core in enumerate(cores):
        # These settings halve the time to build the tree and hardly slow down few queries.
        tree = cKDTree(points[core], leafsize=32, balanced_tree=False, compact_nodes=False)
        spacing_bound = _spacing_quantile(tree)
        width = TUNING.margin * spacing_bound
        # A box test first: points inside the widened box, of the tiles whose boxes overlap it.
        wide_low, wide_high = low[tile] - width, high[tile] + width
        overlaps = ((low <= wide_high) & (high >= wide_low)).all(axis=1)
        overlaps[tile] = False
        inside = [np.empty(0, dtype=np.int32)]
        inside += [
            rows_inside(points, cores[other], wide_low, wide_high)
            for other in np.flatnonzero(overlaps)
        ]
        rows = np.concatenate(inside)
        distance, _ = tree.query(points[rows], distance_upper_bound=width)
        inner = distance < TUNING.charted_margin * spacing_bound
        margins.append((rows[inner], rows[~inner & np.isfinite(distance)]))
    return margins


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
