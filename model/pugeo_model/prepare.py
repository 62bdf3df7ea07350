# SPDX-License-Identifier: Apache-2.0
"""Preparation of a tile for the network: neighbours, canonical frames, areas and patches."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.areas import areas_of_quotas, surface_areas
from pugeo_model.geometry.curves import onto_curves
from pugeo_model.geometry.frames import Frames, fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.overlapping import PointPatch, overlapping_patches
from pugeo_model.geometry.partition import PATCH_SIZE, partition
from pugeo_model.geometry.patches import Patch, extract_patch
from pugeo_model.resample.bounds import bounded_spacing
from pugeo_model.resample.elimination import chart_radii
from pugeo_model.resample.quotas import area_quotas, candidates_per_chart, count_quotas
from pugeo_model.tiles import Tile

__all__ = ["PreparedTile", "prepare"]

_MOST_CANDIDATES = 4  # of all charts, in output points


@dataclass(frozen=True, eq=False)
class PreparedTile:
    """A tile with the inputs of the network and of the resampling.

    Rows are in the order of the patches.

    Attributes:
        tile: the tile.
        cloud: its input points with their attributes; in the order of ``tile.input`` if charts
            represent several points.
        order: ``(M,)`` int32, row of the tile of each point.
        core: ``(M,)`` bool, points of the tile's core.
        points: ``(M, 3)`` float64, unit scale.
        neighbours: ``(M, 32)`` int32, nearest first.
        frames: one canonical frame a point.
        area: ``(M,)`` float64, surface area of each point, unit scale squared.
        quotas: ``(M,)`` float64, relative numbers of output points; ``None`` if all are equal.
        candidates: candidates per chart.
        patches: inputs of the network: `Patch` if it predicts charts, with cores that partition
            the points that get charts; `PointPatch` if it upsamples whole patches.
        noise: of the original input, in spacings, see `noise_level`.
    """

    tile: Tile
    cloud: Cloud
    order: NDArray[np.int32]
    core: NDArray[np.bool_]
    points: NDArray[np.float64]
    neighbours: NDArray[np.int32]
    frames: Frames
    area: NDArray[np.float64]
    quotas: NDArray[np.float64] | None
    candidates: int
    patches: list[Patch] | list[PointPatch]
    noise: float

    @property
    def charted_points(self) -> NDArray[np.float64]:
        """The leading points, ``(charted, 3)``: those with charts."""
        return self.points[: self.tile.charted]

    @property
    def adds_nothing(self) -> bool:
        """True if the output has no new point, only the input points with normals."""
        return self.tile.keeps_input and self.tile.n_out == self.tile.kept

    @property
    def radii(self) -> NDArray[np.float64]:
        """Packing radius ``(M,)`` of the output points around each chart."""
        return chart_radii(self.area, self.quotas, self.core, self.tile.n_out)

    def along_curves(
        self, points: NDArray[np.float64], nearest: NDArray[np.int32]
    ) -> NDArray[np.float64]:
        """Move points ``(K, 3)`` whose nearest chart lies on a curve onto it; others stay.

        Args:
            points: unit scale.
            nearest: ``(K,)`` int32 nearest chart of each.
        """
        if self.tile.on_curve is None:
            return points
        return onto_curves(
            points,
            nearest,
            self.points,
            self.neighbours,
            self.tile.on_curve[self.order],
            self.frames.spacing,
        )

    @property
    def input_points(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Input points ``(m, 3)`` that charts represent, and the chart ``(m,)`` of each."""
        source = self.tile.input
        if source is None or not self.tile.keeps_input:
            return self.charted_points, np.arange(self.tile.charted, dtype=np.int32)
        chart = np.argsort(self.order).astype(np.int32)[source.chart]
        has_chart = chart < self.tile.charted
        return source.points[has_chart], chart[has_chart]


def prepare(tile: Tile) -> PreparedTile:
    """Find neighbours, fit canonical frames and extract the patches of a tile."""
    # With rows in the order of the patches, the core of a patch is a slice of every array.
    cores = partition(tile.points[: tile.charted], PATCH_SIZE)
    order = np.concatenate([*cores, np.arange(tile.charted, len(tile.points), dtype=np.int32)])
    points = tile.points[order]
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances), tile.noise)
    ends = np.cumsum([0] + [len(core) for core in cores])
    patches: list[Patch] | list[PointPatch]
    if tile.patch_ratio is None:
        patches = [
            extract_patch(np.arange(start, stop, dtype=np.int32), points, neighbours, frames)
            for start, stop in itertools.pairwise(ends)
        ]
    else:
        patches = overlapping_patches(points[: tile.charted])
    quotas = _quotas(tile, order, frames.spacing, neighbours)
    candidates = tile.candidates
    if quotas is not None:
        # Bounded, since few charts with large quotas would need much memory.
        most = max(candidates, _MOST_CANDIDATES * tile.n_out // tile.charted)
        candidates = min(candidates_per_chart(candidates, quotas[: tile.charted]), most)
    if quotas is not None and tile.is_even:
        area = areas_of_quotas(quotas, tile.usual_weight)
    else:
        area = surface_areas(frames.spacing, neighbours, _typical_spacing(tile, frames))
    return PreparedTile(
        tile=tile,
        cloud=tile.cloud if tile.input else tile.cloud.take(order),
        order=order,
        core=order < tile.core,
        points=points,
        neighbours=neighbours,
        frames=frames,
        area=area,
        quotas=quotas,
        candidates=candidates,
        patches=patches,
        noise=frames.noise if tile.noisy is None else tile.noisy.noise,
    )


def _quotas(
    tile: Tile,
    order: NDArray[np.int32],
    spacing: NDArray[np.float32],
    neighbours: NDArray[np.int32],
) -> NDArray[np.float64] | None:
    """Relative numbers of output points of the charts ``(M,)``; ``None`` if all are equal."""
    if tile.weights is None:
        return None
    if tile.is_even:
        return area_quotas(bounded_spacing(spacing, neighbours), tile.usual_weight)
    return count_quotas(tile.weights[order], neighbours, tile.usual_weight)


def _typical_spacing(tile: Tile, frames: Frames) -> float | None:
    """Return the median spacing of the whole cloud, ``None`` if the tile is the whole cloud."""
    if tile.spacing is None or tile.noisy is None:
        return tile.spacing
    # The spacing of the whole cloud was measured before denoising; noise increases distances.
    return float(tile.spacing * (np.median(frames.spacing) / tile.noisy.median_spacing))
