# SPDX-License-Identifier: Apache-2.0
"""A large cloud in tiles: memory and time then grow with the cloud no faster than its size.

A tile is a compact part of the cloud, its core, and a margin around it as wide as anything reaches
that decides on points of the core. It goes the whole way of a cloud by itself; only what belongs
to its core is kept. A cloud that is small enough is one tile without a margin.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.boxes import corners, inside
from pugeo_model.geometry.chunks import PATCH_SIZE, chunks
from pugeo_model.geometry.frames import noise_level, rough_residuals
from pugeo_model.geometry.neighbours import NEIGHBOURS, SPACING_NEIGHBOURS, knn, spacing
from pugeo_model.normalise import Placement

__all__ = ["Cut", "Tile", "cut_tiles"]

_POINTS_OUT = 3 << 16  # of a tile's core: what a worker holds at one time
_FEWEST, _MOST = 1 << 14, 1 << 16  # input points of a core: a quarter more to save a tile
# A cloud this much larger than a core stays in one piece: margins would cost more than they save.
# Nor is one tile more made for a small rest.
_WHOLE = 1.5
# In spacings: that far the blend of charts, and their messages, reach in effect. On validation
# shapes in tiles of 1,250 points 4 to 8 make no difference. What even so comes too close to a point
# of another tile is parted in the end, see `finish.seams`.
_MARGIN = 6.5
# In spacings: that far from the core points of the margin get charts and candidates. What is beyond
# only lends its place and its features.
_CHARTED = 3.0
_SAMPLED = 2048  # points at which a tile's noise is measured
_SPACED = 512  # and the spacing by which its margin is wide
_SURVEYED = 8  # tiles in which the noise is measured


@dataclass(frozen=True, eq=False)
class Cut:
    """Which points make up a tile.

    Attributes:
        rows: ``(n,)`` int32 rows of the cloud: the core's, then of the margin those next to it.
        core: how many are the core's.
        charted: how many are the core's or next to it.
        n_out: points of the answer that the tile gives.
    """

    rows: NDArray[np.int32]
    core: int
    charted: int
    n_out: int

    @property
    def patches(self) -> int:
        """Patches that the tile will be cut into."""
        return -(-self.charted // PATCH_SIZE)


@dataclass(frozen=True, eq=False)
class Tile:
    """Part of a cloud, ready to go its way.

    Attributes:
        cloud: the input points: those of the core, then those next to it.
        points: ``(n, 3)`` float64, in the unit scale of the whole cloud.
        rows: ``(n,)`` int32, rows in the cleaned cloud.
        core: how many lead that belong to no other tile.
        charted: how many lead that get charts.
        n_out: points of the answer that the tile gives.
        candidates: candidates a chart.
        keeps_input: the points of the core come back themselves, and the rest is spread among them.
        noise: of the whole cloud, see `noise_level`, or ``None`` where the tile is to find out by
            itself: it is the whole, or was denoised.
        spacing: that half of the whole cloud's points have at most, or ``None`` of the whole.
        placement: offset and scale taken out.
        orient: how normals get their signs, never ``auto``.
        viewpoint: in the cloud's own frame and units.
        centroid: ``(3,)`` of the whole cloud, unit scale.
        seed: decides between points that are as good as each other.
        patch_ratio: R of a network that upsamples whole patches, ``None`` where charts are
            predicted.
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
    placement: Placement
    orient: str
    viewpoint: tuple[float, float, float] | None
    centroid: NDArray[np.float64]
    seed: int
    patch_ratio: int | None = None


def cut_tiles(
    points: NDArray[np.float64], n_out: int, size: int | None = None
) -> tuple[list[Cut], float | None, float | None]:
    """Cut a cloud into tiles.

    Args:
        points: ``(M, 3)``.
        n_out: points of the answer; each tile gives its share, and all together give them exactly.
        size: input points of a core at most; by default about as many as ``n_out`` allows.

    Returns:
        The tiles, whose cores partition the cloud; and what one tile alone cannot know, the cloud's
        noise and its typical spacing, see :class:`Tile`, which are ``None`` for one in one piece.
    """
    count = len(points)
    if size is None:
        size = min(max(_POINTS_OUT * count // n_out, _FEWEST), _MOST)
        size = max(size, -(-count // max(1, round(count / size))))
    if count <= _WHOLE * size:
        return [Cut(np.arange(count, dtype=np.int32), count, count, n_out)], None, None
    cores = chunks(points, size)
    margins = _margins(points, cores)
    ends = [n_out * at // count for at in np.cumsum([0] + [len(core) for core in cores]).tolist()]
    cuts = [
        Cut(np.concatenate([core, *margin]), len(core), len(core) + len(margin[0]), stop - start)
        for core, margin, (start, stop) in zip(
            cores, margins, itertools.pairwise(ends), strict=True
        )
    ]
    return cuts, *_noise_and_spacing(points, cuts[:: -(-len(cuts) // _SURVEYED)])


def _margins(
    points: NDArray[np.float64], cores: list[NDArray[np.int32]]
) -> list[tuple[NDArray[np.int32], NDArray[np.int32]]]:
    """Rows of the points next to each core, and of those beyond that are within its reach."""
    boxes = np.array([corners(points, core) for core in cores])
    low, high = boxes[:, 0], boxes[:, 1]
    found = []
    for tile, core in enumerate(cores):
        # Built in half the time, and no slower for so few questions.
        tree = cKDTree(points[core], leafsize=32, balanced_tree=False, compact_nodes=False)
        typical = _typical_spacing(tree)
        width = _MARGIN * typical
        # First whatever is in the widened box, of those tiles whose boxes it touches.
        reach_low, reach_high = low[tile] - width, high[tile] + width
        touched = ((low <= reach_high) & (high >= reach_low)).all(axis=1)
        touched[tile] = False
        around = [np.empty(0, dtype=np.int32)]
        around += [
            inside(points, cores[other], reach_low, reach_high) for other in np.flatnonzero(touched)
        ]
        boxed = np.concatenate(around)
        apart, _ = tree.query(points[boxed], distance_upper_bound=width)
        near = apart < _CHARTED * typical
        found.append((boxed[near], boxed[~near & np.isfinite(apart)]))
    return found


def _typical_spacing(tree: cKDTree) -> float:
    """A spacing that nine in ten points of a tree do not exceed."""
    some = tree.data[:: max(1, tree.n // _SPACED)]
    distances, _ = knn(tree, some, SPACING_NEIGHBOURS + 1)
    return float(np.quantile(distances[:, 1:].mean(axis=1), 0.9))


def _noise_and_spacing(points: NDArray[np.float64], cuts: list[Cut]) -> tuple[float, float]:
    """The noise of a cloud and its typical spacing, by points of some tiles."""
    residuals, spacings = [], []
    for cut in cuts:
        here = points[cut.rows]
        some = np.arange(0, cut.core, max(1, cut.core // _SAMPLED))
        distances, rows = knn(cKDTree(here), here[some], NEIGHBOURS + 1)
        # Residuals are those of the leading rows, so the sampled points are put there once more.
        near = (rows[:, 1:] + len(some)).astype(np.int32)
        stacked = np.concatenate([here[some], here])
        spacings.append(spacing(distances[:, 1:].astype(np.float32)))
        residuals.append(rough_residuals(stacked, near, spacings[-1]))
    return noise_level(np.concatenate(residuals)), float(np.median(np.concatenate(spacings)))
