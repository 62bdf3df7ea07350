# SPDX-License-Identifier: Apache-2.0
"""The stages of a tile on workers, for the orchestration `pugeo_model.pipeline.upsample_tile`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from pugeo_service.engine import stages
from pugeo_service.engine.backend import Handle
from pugeo_service.engine.dispatch import Dispatch, WorkerOf
from pugeo_service.engine.messages import ModelId, PreparedInfo, ProgressCallbacks
from pugeo_service.engine.values import DenseTile, PredictedBatch, Prepared

if TYPE_CHECKING:
    from pugeo_model.stage_times import StageTimes

__all__ = ["PreparedHandle", "TileHandle", "WorkerStages"]


@dataclass(frozen=True)
class PreparedHandle:
    """A prepared tile on a worker.

    Attributes:
        handle: of the tile.
        info: its description.
    """

    handle: Handle[Prepared]
    info: PreparedInfo


@dataclass(frozen=True)
class TileHandle:
    """A tile of a cloud on a worker.

    Attributes:
        number: of the tile, from 0.
        prepared: the tile if it is prepared already. The only tile of a cloud is prepared when the
            cloud is read, a denoised tile in the task that moves its points.
    """

    number: int
    prepared: PreparedHandle | None = None


class WorkerStages:
    """Runs each stage of a tile as a task, or as several side by side.

    Args:
        tasks: of the request.
        cloud: handle of the planned cloud.
        model: weights of the network.
        patches: of the whole cloud, which decide on the priority of tasks.
        progress: told which stage begins, and the patches done.
        times: gets the seconds of all stages.
        worker_of: the worker that all tasks of the tile stay on, if any.
        batches: gets the seconds and patches of all runs through the network.
    """

    def __init__(
        self,
        tasks: Dispatch,
        cloud: Handle[Prepared],
        model: ModelId,
        patches: int,
        progress: ProgressCallbacks,
        times: "StageTimes",
        batches: list[tuple[float, int]],
        worker_of: WorkerOf = lambda: None,
    ) -> None:
        self._tasks, self._cloud, self._model, self._patches = tasks, cloud, model, patches
        self._progress, self._times, self._batches = progress, times, batches
        self._worker_of = worker_of
        self._on_done: Callable[[int], object] = progress.on_done

    async def prepare(self, tile: TileHandle) -> PreparedHandle:
        """Find neighbours, fit canonical frames, cut patches."""
        if tile.prepared is not None:
            return tile.prepared
        taken = self._tasks.submit(stages.take_tile, self._cloud, tile.number)
        handle, info = await self._tasks.step(
            self._patches,
            stages.prepare_tile,
            (taken,),
            stages.describe_prepared,
            worker=self._worker_of(),
        )
        self._tasks.drop(taken)
        self._times.add(info.seconds)
        return PreparedHandle(handle, info)

    async def predict(self, prepared: PreparedHandle) -> list[Handle[PredictedBatch]]:
        """Run all patches through the network."""
        self._progress.on_stage("predict")
        with self._times.measure("predict"):
            charts = await self._tasks.predict(
                prepared.handle, prepared.info.patches, self._worker_of, self._on_done
            )
        # A denoised tile is predicted once more; its patches were counted already.
        self._on_done = lambda _: None
        return charts

    def needs_denoising(self, prepared: PreparedHandle) -> bool:
        """Whether the points are noisy and were not moved yet."""
        return prepared.info.noisy

    async def denoise(
        self, prepared: PreparedHandle, charts: list[Handle[PredictedBatch]]
    ) -> TileHandle | None:
        """Move the points onto their charts; ``None`` if they hardly move."""
        handle, info = await self._tasks.step(
            self._patches,
            stages.denoise,
            (prepared.handle, charts, self._model),
            stages.describe_denoised,
            worker=self._worker_of(),
        )
        if info is None:
            self._tasks.drop(handle)
            return None
        self._times.add(info.seconds)
        self._tasks.drop(*charts)
        if prepared.handle is not self._cloud:
            self._tasks.drop(prepared.handle)
        return TileHandle(0, PreparedHandle(cast("Handle[Prepared]", handle), info))

    async def densify(
        self, prepared: PreparedHandle, charts: list[Handle[PredictedBatch]]
    ) -> Handle[DenseTile]:
        """Make the dense points."""
        self._progress.on_stage("finish")
        handle, info = await self._tasks.step(
            self._patches,
            stages.densify,
            (prepared.handle, charts, self._model),
            stages.describe_dense,
            worker=self._worker_of(),
        )
        self._tasks.drop(*charts)
        if prepared.handle is not self._cloud:
            self._tasks.drop(prepared.handle)
        self._times.add(info.seconds)
        self._batches += info.batches
        return handle
