# SPDX-License-Identifier: Apache-2.0
"""The orchestration of one request, from the bytes of its body to the bytes of its answer.

There are three ways to the bytes (medians of one run with two workers on two cores, Zen 3):

- A small cloud is upsampled in the task that reads it: 2,000 points at R=4 take 368 ms, in separate
  tasks 455 ms.
- Tiles of a large cloud are written where they are if the format consists of rows. This bounds
  memory, and saves no time: 100,000 points at R=8 take 12.2 s, assembled on one worker 11.4 s.
- All other answers are assembled on one worker.
"""

import asyncio
import itertools
import time
from collections import deque
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from pugeo_model.pipeline import upsample_tile
from pugeo_model.stage_times import StageTimes
from pugeo_service.engine import output_stages, stages
from pugeo_service.engine.backend import Backend, Handle
from pugeo_service.engine.collector import Collector
from pugeo_service.engine.dispatch import Dispatch, WorkerOf
from pugeo_service.engine.errors import disk_errors
from pugeo_service.engine.messages import (
    BodyReader,
    OutputInfo,
    PreparedInfo,
    ProgressCallbacks,
    RunRequest,
    RunResult,
)
from pugeo_service.engine.scheduling import LARGE_PATCHES, SchedulingPolicy
from pugeo_service.engine.values import DenseTile, Output, Prepared
from pugeo_service.engine.worker_stages import PreparedHandle, TileHandle, WorkerStages
from pugeo_service.storage.spool import Spool

__all__ = ["Orchestrator"]

_WRITERS = 3  # tiles written at a time: enough to keep the front busy


class Orchestrator:
    """Runs one request on a backend.

    Args:
        backend: runs the tasks.
        request: to run.
        policy: decides on the order among all requests of the engine.
        progress: told how far the run is.
        spool_dir: folder for the answer.
    """

    def __init__(
        self,
        backend: Backend,
        request: RunRequest,
        policy: SchedulingPolicy,
        progress: ProgressCallbacks,
        spool_dir: Path,
    ) -> None:
        self._backend = backend
        self._request = request
        self._policy = policy
        self._progress = progress
        self._spool_dir = spool_dir
        self._tasks = Dispatch(backend, request, policy)
        self._times = StageTimes()
        self._batches: list[tuple[float, int]] = []

    async def run(self, body: BodyReader) -> RunResult:
        """Run the request to its end.

        Args:
            body: read once the run may begin.

        Raises:
            CloudError: the input cannot be used.
            WorkerLostError, EngineLostError: see `Backend`.
            DiskError: the body cannot be read, or there is no room for the answer.
        """
        with disk_errors():
            spool = Spool(self._spool_dir)
        try:
            async with AsyncExitStack() as held:
                report = await self._run(body, spool, held)
            return RunResult(spool, report, self._times.seconds, self._batches)
        except BaseException:
            spool.close()
            raise
        finally:
            self._policy.unregister(self)
            self._tasks.cancel()

    async def _run(self, body: BodyReader, spool: Spool, held: AsyncExitStack) -> dict[str, Any]:
        """Write the answer into the spool; return the report of the run."""
        request, arrived = self._request, time.perf_counter()
        # A large cloud waits for its turn on disk. Few jobs run at a time already.
        patches = request.estimate(body.size, request.format)
        if patches >= LARGE_PATCHES and not request.background:
            await held.enter_async_context(self._policy.large_requests)
        self._policy.register(self, patches, background=request.background)
        self._progress.on_stage("prepare")
        with disk_errors():
            data = await body.read()
        answer = Collector(spool, await spool.share(), self._tasks)

        # One task reads and plans the cloud; of a small cloud it makes the whole answer.
        if self._tasks.every_worker_is_busy and not request.background:
            request = replace(request, one_task_patches=LARGE_PATCHES - 1)
        request = replace(request, worker_bytes=self._backend.worker_memory)
        cloud, info = await self._tasks.step(
            patches, stages.prepare, (data, request), stages.describe_prepared, (answer.file,)
        )
        del data  # the backend has a copy for as long as the task may have to be repeated
        self._record_prepared(info, time.perf_counter() - arrived)
        self._policy.register(self, info.patches, background=request.background)
        self._progress.on_patches(info.patches)
        if info.patches < LARGE_PATCHES:
            await held.aclose()

        if info.output is not None:
            self._progress.on_done(info.patches)
            return await self._collect(answer, cloud, info.output)
        tiles = await self._upsample_tiles(cloud, info)
        if info.by_rows and info.tiles > 1:
            return await self._write_by_rows(cloud, tiles, answer)
        output, written = await self._tasks.step(
            info.patches,
            output_stages.assemble,
            (cloud, tiles, request.answer),
            output_stages.describe_output,
            (answer.file,),
        )
        self._tasks.drop(cloud, *tiles)
        self._times.add(written.seconds)
        return await self._collect(answer, output, written)

    def _record_prepared(self, info: PreparedInfo, elapsed: float) -> None:
        """Record seconds so far; time that no stage accounts for was spent in queues."""
        spent = StageTimes()
        spent.add(info.seconds)
        if info.output is not None:
            spent.add(info.output.seconds)
            self._batches += info.output.batches
        self._times.add({"queue": elapsed - sum(spent.seconds.values()), **spent.seconds})

    async def _upsample_tiles(
        self, cloud: Handle[Prepared], info: PreparedInfo
    ) -> list[Handle[DenseTile]]:
        """Upsample all tiles, as many at a time as there are workers; return them in order.

        Each worker has tiles of its own, which saves carrying their patches about. One that has
        no tile left helps the others. The only tile of a cloud is shared by all workers.
        """
        if info.tiles == 1:
            only = TileHandle(0, PreparedHandle(cloud, info))
            return [await upsample_tile(self._stages(cloud, info.patches), only)]
        done: dict[int, Handle[DenseTile]] = {}
        numbers = iter(range(info.tiles))
        workers = self._backend.worker_names
        busy = set(workers)

        async def upsample_some(worker: str | None) -> None:
            def worker_of() -> str | None:
                return worker if len(busy) == len(workers) else None

            for number in numbers:
                tile_stages = self._stages(cloud, info.patches, worker_of)
                done[number] = await upsample_tile(tile_stages, TileHandle(number))
            busy.discard(worker or "")

        running = [asyncio.create_task(upsample_some(worker)) for worker in workers or (None,)]
        try:
            await asyncio.gather(*running)
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)
        return [done[number] for number in range(info.tiles)]

    def _stages(
        self, cloud: Handle[Prepared], patches: int, worker_of: WorkerOf = lambda: None
    ) -> WorkerStages:
        return WorkerStages(
            self._tasks,
            cloud,
            self._request.model,
            patches,
            self._progress,
            self._times,
            self._batches,
            worker_of,
        )

    async def _collect(
        self, answer: Collector, source: Handle[Output] | Handle[Prepared], info: OutputInfo
    ) -> dict[str, Any]:
        self._progress.on_stage("collect")
        with self._times.measure("collect"):
            await answer.collect(source, info)
            await answer.flush()
        return info.report

    async def _write_by_rows(
        self, cloud: Handle[Prepared], tiles: list[Handle[DenseTile]], answer: Collector
    ) -> dict[str, Any]:
        """Write each tile on its worker, and collect the bytes here in order."""
        self._progress.on_stage("finish")
        borders = [self._tasks.submit(output_stages.border, tile) for tile in tiles]
        agreements, agreed = await self._tasks.step(
            LARGE_PATCHES,
            output_stages.agree,
            (cloud, borders, self._request.answer),
            output_stages.describe_agreements,
        )
        self._tasks.drop(cloud, *borders)
        self._times.add(agreed.seconds)

        async def write(number: int, tile: Handle[DenseTile]) -> tuple[Handle[Output], OutputInfo]:
            written = await self._tasks.step(
                LARGE_PATCHES,
                output_stages.write_tile,
                (tile, agreements, number),
                output_stages.describe_output,
                # Its place in the file is known once the tiles before it are there.
                (None,),
            )
            self._tasks.drop(tile)
            return written

        self._progress.on_stage("collect")
        # Workers write the next tiles while these are brought here.
        window = min(self._backend.warm_workers, _WRITERS) + 1
        waiting = enumerate(tiles)
        writing: deque[asyncio.Task[tuple[Handle[Output], OutputInfo]]] = deque()
        try:
            while True:
                for each in itertools.islice(waiting, window - len(writing)):
                    writing.append(asyncio.create_task(write(*each)))
                if not writing:
                    break
                output, info = await writing.popleft()
                self._times.add(info.seconds)
                with self._times.measure("collect"):
                    await answer.collect(output, info)
                self._tasks.drop(output)
        finally:
            for task in writing:
                task.cancel()
            await asyncio.gather(*writing, return_exceptions=True)
        with self._times.measure("collect"):
            await answer.flush()
        self._tasks.drop(agreements)
        return agreed.report
