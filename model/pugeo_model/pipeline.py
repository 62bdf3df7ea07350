# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud: read, clean, normalise, patches, network, merge, finish, write.

    cloud = read("scan.ply")                    # formats
    plan  = make_plan(cloud, options)           # clean, normalise, cut into tiles
    tiles = [await upsample_tile(stages, tile) for tile in plan.tiles]
    cloud, report = assemble(plan, tiles)       # tiles agree on signs and borders, then are joined
    write(cloud, "dense.ply")                   # formats

`upsample_tile` is the only orchestration: the command line runs it with `LocalStages`, the service
with stages that run on workers, the baselines with stages that learned nothing.
"""

from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from pugeo_model.denoise import denoised_tile, needs_denoising
from pugeo_model.finish import UpsampledTile, finish
from pugeo_model.prepare import PreparedTile, prepare
from pugeo_model.resample.atlas import Atlas, PatchCharts
from pugeo_model.resample.queries import input_queries, propose, select_survivors
from pugeo_model.stage_times import StageTimes
from pugeo_model.tiles import Tile

if TYPE_CHECKING:
    from pugeo_model.network.model import Model

__all__ = ["LocalStages", "TileStages", "denoise", "densify", "run_here", "upsample_tile"]

TileT = TypeVar("TileT")
PreparedT = TypeVar("PreparedT")
ChartsT = TypeVar("ChartsT")
DenseT_co = TypeVar("DenseT_co", covariant=True)
T = TypeVar("T")


class TileStages(Protocol[TileT, PreparedT, ChartsT, DenseT_co]):
    """The stages of a tile, run here or on workers.

    The type parameters are the values that pass between stages: the values themselves here,
    handles of values where the stages run on workers.
    """

    async def prepare(self, tile: TileT) -> PreparedT:
        """Find neighbours, fit canonical frames, cut patches."""

    async def predict(self, prepared: PreparedT) -> ChartsT:
        """Run all patches through the network."""

    def needs_denoising(self, prepared: PreparedT) -> bool:
        """Whether the points are noisy and were not moved yet."""

    async def denoise(self, prepared: PreparedT, charts: ChartsT) -> TileT | None:
        """Move the points onto their charts; ``None`` where they hardly move."""

    async def densify(self, prepared: PreparedT, charts: ChartsT) -> DenseT_co:
        """Make the dense points: propose, project, select, project, finish."""


async def upsample_tile(
    stages: TileStages[TileT, PreparedT, ChartsT, DenseT_co], tile: TileT
) -> DenseT_co:
    """Take a tile from its points to its dense points (section 3 of the paper).

    Args:
        stages: how each stage is run.
        tile: the points of a core and of the margin around it.
    """
    # Every neighbourhood is turned, scaled and bent into a canonical frame, so that the network
    # needs to learn neither rotation nor density.
    prepared = await stages.prepare(tile)
    # Features of each neighbourhood; from them a chart at each point: samples (u, v) in the plane
    # (eq. 3), the matrix T that lifts them to the tangent plane (eq. 4, 5).
    charts = await stages.predict(prepared)
    if stages.needs_denoising(prepared):
        # Points of a noisy input are moved onto their own charts, and charts are predicted once
        # more from there. Points that hardly move are exact, and their charts hold.
        moved = await stages.denoise(prepared, charts)
        if moved is not None:
            prepared = await stages.prepare(moved)
            charts = await stages.predict(prepared)
    # Displacements and normals of the candidates (eq. 6 to 8), and the choice among them.
    return await stages.densify(prepared, charts)


def denoise(model: "Model", prepared: PreparedTile, charts: Sequence[PatchCharts]) -> Tile | None:
    """Move the points of a noisy tile onto their charts; ``None`` where they hardly move."""
    atlas = Atlas.of(prepared.points, prepared.frames, charts)
    return denoised_tile(prepared, model.project(input_queries(prepared, atlas)))


def densify(
    model: "Model", prepared: PreparedTile, charts: Sequence[PatchCharts], times: StageTimes
) -> UpsampledTile:
    """Make the dense points of a tile from its charts.

    Args:
        model: its heads project points onto charts.
        prepared: the tile.
        charts: of all its patches, in any order.
        times: gets the seconds of ``project``, ``merge`` and ``finish``.
    """
    with times.measure("merge"):
        atlas = Atlas.of(prepared.points, prepared.frames, charts)
        # One and a half times as many candidates as points are wanted, on tangent planes.
        query = propose(prepared, atlas)
    with times.measure("project"):
        # Along the normal onto the blend of the charts around, with the error expected there:
        # charts of neighbours pull outliers in before the choice.
        candidates = model.project(query)
    with times.measure("merge"):
        # Weighted sample elimination keeps the number wanted, repulsion spreads the survivors.
        query = select_survivors(prepared, atlas, candidates)
        del candidates  # the largest arrays of all
    with times.measure("project"):
        survivors = model.project(query)
    with times.measure("finish"):
        return finish(prepared, survivors)


class LocalStages:
    """All stages in this process.

    Args:
        model: the network.
        progress: called with the name of a stage that begins and the share of it that is done,
            0..1, and before each patch of the network.

    Attributes:
        times: seconds of each stage so far.
        batches: seconds and number of patches of each run through the network.
    """

    def __init__(self, model: "Model", progress: Callable[[str, float], object]) -> None:
        self._model = model
        self._progress = progress
        self.times = StageTimes(on_begin=lambda stage: progress(stage, 0.0))
        self.batches: list[tuple[float, int]] = []

    async def prepare(self, tile: Tile) -> PreparedTile:
        """Find neighbours, fit canonical frames, cut patches."""
        with self.times.measure("prepare"):
            return prepare(tile)

    async def predict(self, prepared: PreparedTile) -> list[PatchCharts]:
        """Run patches through the network one at a time: results depend on no batch."""
        charts: list[PatchCharts] = []
        before = self.times.seconds.get("predict", 0.0)
        with self.times.measure("predict"):
            for patch in prepared.patches:
                self._progress("predict", len(charts) / len(prepared.patches))
                charts.append(self._model.charts(patch, prepared.tile.candidates))
        self.batches.append((self.times.seconds["predict"] - before, len(charts)))
        return charts

    def needs_denoising(self, prepared: PreparedTile) -> bool:
        """Whether the points are noisy and were not moved yet."""
        return needs_denoising(prepared)

    async def denoise(self, prepared: PreparedTile, charts: list[PatchCharts]) -> Tile | None:
        """Move the points onto their charts; ``None`` where they hardly move."""
        with self.times.measure("prepare"):
            return denoise(self._model, prepared, charts)

    async def densify(self, prepared: PreparedTile, charts: list[PatchCharts]) -> UpsampledTile:
        """Make the dense points."""
        return densify(self._model, prepared, charts, self.times)


def run_here(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine whose stages all run in this process, so that it never waits."""
    try:
        coroutine.send(None)
    except StopIteration as done:
        value: T = done.value
        return value
    coroutine.close()
    raise RuntimeError("a local stage waited for an event loop")
