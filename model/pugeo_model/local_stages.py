# SPDX-License-Identifier: Apache-2.0
"""Stages of a tile, run in this process, and the networks that they call."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from pugeo_model.denoise import denoised_tile, needs_denoising
from pugeo_model.finish import UpsampledTile, finish
from pugeo_model.geometry.overlapping import PointPatch
from pugeo_model.geometry.patches import Patch
from pugeo_model.prepare import PreparedTile, prepare
from pugeo_model.queries import input_queries, propose, select_survivors
from pugeo_model.resample.atlas import Atlas, PatchCharts, Projected, ProjectionQuery
from pugeo_model.resample.overlap import PatchPoints, merge_overlapping
from pugeo_model.stage_times import StageTimes
from pugeo_model.tiles import Tile

__all__ = [
    "ChartNetwork", "LocalStages", "Network", "PatchNetwork", "Predicted", "denoise", "densify",
    "predict",
]  # fmt: skip

KindT = TypeVar("KindT")


class ChartNetwork(Protocol):
    """A network that predicts a chart for each point, and projects points onto charts."""

    patch_ratio: None

    def charts(self, patch: Patch, count: int) -> PatchCharts:
        """Predict the charts of the core of a patch, each with ``count`` candidates."""

    def project(self, query: ProjectionQuery) -> Projected:
        """Project each query point onto the blend of its charts."""


class PatchNetwork(Protocol):
    """A network that upsamples whole patches.

    Attributes:
        patch_ratio: number of output points for each input point.
    """

    patch_ratio: int

    def charts(self, patch: PointPatch, count: int) -> PatchPoints:
        """Upsample a patch; ``count`` is ignored, since ``patch_ratio`` is the number."""


Network = ChartNetwork | PatchNetwork
"""Either kind; ``patch_ratio`` tells them apart."""

Predicted = PatchCharts | PatchPoints
"""Charts, or output points, of one patch, as a network of either kind predicts them."""


def predict(network: Network, patch: Patch | PointPatch, candidates: int) -> Predicted:
    """Run a patch through the network.

    Args:
        network: a network of either kind.
        patch: its input: a `Patch` if it predicts charts, else a `PointPatch`.
        candidates: candidates per chart; a network that upsamples whole patches ignores it.
    """
    if network.patch_ratio is None:
        assert isinstance(patch, Patch)
        return network.charts(patch, candidates)
    assert isinstance(patch, PointPatch)
    return network.charts(patch, candidates)


def merge_patches(prepared: PreparedTile, patches: Sequence[PatchPoints]) -> Projected:
    """Select the output points of a network that upsamples whole patches."""
    tile = prepared.tile
    return merge_overlapping(
        prepared.points, prepared.core, patches, tile.n_out, keeps_input=tile.keeps_input
    )


def denoise(network: Network, prepared: PreparedTile, charts: Sequence[Predicted]) -> Tile | None:
    """Move the points of a noisy tile onto their charts; ``None`` if they hardly move."""
    assert network.patch_ratio is None, "only charts can denoise"
    atlas = Atlas.of(prepared.points, prepared.frames, _all_of(PatchCharts, charts))
    return denoised_tile(prepared, network.project(input_queries(prepared, atlas)))


def densify(
    network: Network, prepared: PreparedTile, charts: Sequence[Predicted], times: StageTimes
) -> UpsampledTile:
    """Compute the dense points of a tile from its charts.

    Args:
        network: projects points onto charts with its heads, if it predicts charts.
        prepared: the tile.
        charts: charts or points of all its patches, in any order.
        times: receives the seconds of ``project``, ``merge`` and ``finish``.
    """
    if network.patch_ratio is None:
        return _densify_charts(network, prepared, _all_of(PatchCharts, charts), times)
    with times.measure("merge"):
        merged = merge_patches(prepared, _all_of(PatchPoints, charts))
    with times.measure("finish"):
        return finish(prepared, merged)


def _densify_charts(
    network: ChartNetwork,
    prepared: PreparedTile,
    charts: Sequence[PatchCharts],
    times: StageTimes,
) -> UpsampledTile:
    """Propose candidates, project them, select among them, project again, finish."""
    with times.measure("merge"):
        atlas = Atlas.of(prepared.points, prepared.frames, charts)
        # Candidates on the tangent planes (eq. 4), 1.5 times as many as output points.
        query = propose(prepared, atlas)
    with times.measure("project"):
        # Displacement onto the blended charts (eq. 6, 7) before the selection, so that outliers
        # are moved first; the charts also predict their error.
        candidates = network.project(query)
    with times.measure("merge"):
        # Sample elimination keeps the requested number, repulsion makes their spacing even.
        query = select_survivors(prepared, atlas, candidates)
        del candidates  # these arrays are the largest
    with times.measure("project"):
        survivors = network.project(query)
    with times.measure("finish"):
        return finish(prepared, survivors)


def _all_of(kind: type[KindT], values: Sequence[object]) -> list[KindT]:
    """Return the values as a list of one type; fail if one of them has another type."""
    chosen = [value for value in values if isinstance(value, kind)]
    assert len(chosen) == len(values), "predicted by a network of the other kind"
    return chosen


class LocalStages:
    """The stages of `upsample_tile`, run in this process.

    Args:
        network: the network.
        progress: called with the name of the current stage and the completed fraction of it,
            0..1: at the begin of each stage and before each patch of the network.

    Attributes:
        times: seconds of each stage so far.
        batches: seconds and number of patches of each ``predict``.
    """

    def __init__(self, network: Network, progress: Callable[[str, float], object]) -> None:
        self._network = network
        self._progress = progress
        self.times = StageTimes(on_begin=lambda stage: progress(stage, 0.0))
        self.batches: list[tuple[float, int]] = []

    async def prepare(self, tile: Tile) -> PreparedTile:
        """Find neighbours, fit canonical frames and extract patches."""
        with self.times.measure("prepare"):
            return prepare(tile)

    async def predict(self, prepared: PreparedTile) -> list[Predicted]:
        """Run patches through the network one at a time, so that no result depends on batching."""
        charts: list[Predicted] = []
        before = self.times.seconds.get("predict", 0.0)
        with self.times.measure("predict"):
            for patch in prepared.patches:
                self._progress("predict", len(charts) / len(prepared.patches))
                charts.append(predict(self._network, patch, prepared.candidates))
        self.batches.append((self.times.seconds["predict"] - before, len(charts)))
        return charts

    def needs_denoising(self, prepared: PreparedTile) -> bool:
        """Return whether the points are noisy and were not moved yet."""
        return needs_denoising(prepared)

    async def denoise(self, prepared: PreparedTile, charts: list[Predicted]) -> Tile | None:
        """Move the points onto their charts; ``None`` if they hardly move."""
        with self.times.measure("prepare"):
            return denoise(self._network, prepared, charts)

    async def densify(self, prepared: PreparedTile, charts: list[Predicted]) -> UpsampledTile:
        """Compute the dense points."""
        return densify(self._network, prepared, charts, self.times)
