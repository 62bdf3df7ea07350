# SPDX-License-Identifier: Apache-2.0
"""Stages of a tile, run in this process."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pugeo_model.denoise import denoised_tile, needs_denoising
from pugeo_model.finish import UpsampledTile, finish
from pugeo_model.prepare import PreparedTile, prepare
from pugeo_model.queries import input_queries, propose, select_survivors
from pugeo_model.resample.atlas import Atlas, PatchCharts, Projected
from pugeo_model.resample.overlap import PatchPoints, merge_overlapping
from pugeo_model.stage_times import StageTimes
from pugeo_model.tiles import Tile

if TYPE_CHECKING:
    from pugeo_model.network.model import Model

__all__ = ["LocalStages", "denoise", "densify"]


def merge_patches(prepared: PreparedTile, patches: Sequence[PatchPoints]) -> Projected:
    """Select the output points of a network that upsamples whole patches."""
    tile = prepared.tile
    return merge_overlapping(
        prepared.points, prepared.core, patches, tile.n_out, keeps_input=tile.keeps_input
    )


def denoise(model: "Model", prepared: PreparedTile, charts: Sequence[PatchCharts]) -> Tile | None:
    """Move the points of a noisy tile onto their charts; ``None`` if they hardly move."""
    atlas = Atlas.of(prepared.points, prepared.frames, charts)
    return denoised_tile(prepared, model.project(input_queries(prepared, atlas)))


def densify(
    model: Any, prepared: PreparedTile, charts: Sequence[Any], times: StageTimes
) -> UpsampledTile:
    """Compute the dense points of a tile from its charts.

    Args:
        model: projects points onto charts with its heads.
        prepared: the tile.
        charts: charts or points of all its patches, in any order.
        times: receives the seconds of ``project``, ``merge`` and ``finish``.
    """
    if prepared.tile.patch_ratio is not None:
        with times.measure("merge"):
            merged = merge_patches(prepared, charts)
        with times.measure("finish"):
            return finish(prepared, merged)
    with times.measure("merge"):
        atlas = Atlas.of(prepared.points, prepared.frames, charts)
        # Candidates on the tangent planes (eq. 4), 1.5 times as many as output points.
        query = propose(prepared, atlas)
    with times.measure("project"):
        # Displacement onto the blended charts (eq. 6, 7) before the selection, so that outliers
        # are moved first; the charts also predict their error.
        candidates = model.project(query)
    with times.measure("merge"):
        # Sample elimination keeps the requested number, repulsion makes their spacing even.
        query = select_survivors(prepared, atlas, candidates)
        del candidates  # these arrays are the largest
    with times.measure("project"):
        survivors = model.project(query)
    with times.measure("finish"):
        return finish(prepared, survivors)


class LocalStages:
    """The stages of `upsample_tile`, run in this process.

    Args:
        model: the network.
        progress: called with the name of the current stage and the completed fraction of it,
            0..1: at the begin of each stage and before each patch of the network.

    Attributes:
        times: seconds of each stage so far.
        batches: seconds and number of patches of each ``predict``.
    """

    def __init__(self, model: Any, progress: Callable[[str, float], object]) -> None:
        self._model = model
        self._progress = progress
        self.times = StageTimes(on_begin=lambda stage: progress(stage, 0.0))
        self.batches: list[tuple[float, int]] = []

    async def prepare(self, tile: Tile) -> PreparedTile:
        """Find neighbours, fit canonical frames and extract patches."""
        with self.times.measure("prepare"):
            return prepare(tile)

    async def predict(self, prepared: PreparedTile) -> list[Any]:
        """Run patches through the network one at a time, so that no result depends on batching."""
        charts: list[Any] = []
        before = self.times.seconds.get("predict", 0.0)
        with self.times.measure("predict"):
            for patch in prepared.patches:
                self._progress("predict", len(charts) / len(prepared.patches))
                charts.append(self._model.charts(patch, prepared.candidates))
        self.batches.append((self.times.seconds["predict"] - before, len(charts)))
        return charts

    def needs_denoising(self, prepared: PreparedTile) -> bool:
        """Return whether the points are noisy and were not moved yet."""
        return needs_denoising(prepared)

    async def denoise(self, prepared: PreparedTile, charts: list[PatchCharts]) -> Tile | None:
        """Move the points onto their charts; ``None`` if they hardly move."""
        with self.times.measure("prepare"):
            return denoise(self._model, prepared, charts)

    async def densify(self, prepared: PreparedTile, charts: list[PatchCharts]) -> UpsampledTile:
        """Compute the dense points."""
        return densify(self._model, prepared, charts, self.times)
