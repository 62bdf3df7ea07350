# SPDX-License-Identifier: Apache-2.0
"""The graph of tasks of one request, from the bytes of its body to the bytes of its answer."""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_service.engine.errors import disk
from pugeo_service.engine.order import Head, Order, Outcome, Sheet, Watcher
from pugeo_service.engine.pool import Pool, Stage
from pugeo_service.spool import Spool

__all__ = ["LONG_PATCHES", "Flow"]

# From here on, preparing, merging and finishing take seconds.
LONG_PATCHES = 8
# A large order that got nothing done for so long has its next batch run first; see `_spread`.
_PATIENCE_S = 5.0
_FIRST = 1e9
# Whatever somebody waits for comes before whatever nobody waits for, but for the batch that
# _PATIENCE_S gives a background order: no cloud has so many patches.
_BEHIND = -1e8
_BEHIND_FIRST = -1e7


class Flow:
    """One request on its way through the pool.

    Args:
        pool: where the tasks run.
        order: what to do.
        long: slots for long stages, one fewer than workers, so that one worker is always left
            for small requests.
        watcher: who is told how far it is.
        spool_dir: folder for the answer.
    """

    def __init__(
        self,
        pool: Pool,
        order: Order,
        long: asyncio.Semaphore,
        watcher: Watcher,
        spool_dir: Path,
    ) -> None:
        self._pool = pool
        self._order = order
        self._long = long
        self._watcher = watcher
        self._spool_dir = spool_dir
        self._ends = time.monotonic() + order.deadline_s
        # What a task ranks by comes on top of this; within a background order small is first too.
        self._base = _BEHIND if order.background else 0.0
        self._soon = _BEHIND_FIRST if order.background else _FIRST
        self._handles: set[Any] = set()

    async def run(self, body: NDArray[np.uint8]) -> Outcome:
        """Do it.

        Args:
            body: uint8 ``(size,)``.

        Raises:
            CloudError: the input cannot be used.
            WorkerLost, EngineLost: see the pool.
            DiskFailed: there is no room for the answer.
        """
        try:
            return await self._run(body)
        finally:
            self._pool.cancel(self._handles)

    async def _run(self, body: NDArray[np.uint8]) -> Outcome:
        order, seconds, began = self._order, {}, time.perf_counter()

        size = order.estimate(len(body))
        head: Head
        self._watcher.on_stage("prepare")
        prepared, head = await self._step(size, "prepare", "describe_prepared", body, order)
        seconds["queue"] = time.perf_counter() - began - sum(head.seconds.values())
        seconds.update(head.seconds)
        size = head.patches
        self._watcher.on_patches(size)

        self._watcher.on_stage("predict")
        began = time.perf_counter()
        charted = await self._spread(
            size,
            order.batch_patches,
            "cut_patches",
            "predict",
            prepared,
            self._watcher.on_done,
        )
        seconds["predict"] = time.perf_counter() - began

        self._watcher.on_stage("land")
        proposed, (landings, proposing, batches) = await self._step(
            size, "propose", "describe_merged", prepared, charted
        )
        began = time.perf_counter()
        candidates = await self._spread(
            landings, order.batch_patches, "cut_landings", "land", proposed
        )
        seconds["land"] = time.perf_counter() - began

        self._watcher.on_stage("merge")
        merged, (landings, merging, _) = await self._step(
            size, "merge", "describe_merged", prepared, charted, candidates
        )
        seconds["merge"] = proposing + merging
        self._drop([proposed, *charted, *candidates])

        self._watcher.on_stage("land")
        began = time.perf_counter()
        landed = await self._spread(landings, order.batch_patches, "cut_landings", "land", merged)
        seconds["land"] += time.perf_counter() - began

        sheet: Sheet
        self._watcher.on_stage("finish")
        written, sheet = await self._step(
            size, "finish", "describe_written", prepared, landed, order.answer
        )
        seconds.update(sheet.seconds)
        self._drop([prepared, merged, *landed])

        self._watcher.on_stage("collect")
        began = time.perf_counter()
        spool = await self._collect(written, sheet)
        seconds["collect"] = time.perf_counter() - began
        return Outcome(spool, sheet.report, seconds, batches)

    async def _step(self, size: int, stage: Stage, describe: Stage, *args: Any) -> tuple[Any, Any]:
        """Run a stage of the whole cloud; return the handle of its result and a description."""
        long = size >= LONG_PATCHES
        async with self._long if long else _free:
            handle = self._submit(stage, *args, priority=self._base - size, long=long)
            # Queued right away: a question asked later would cost another round trip.
            described = self._submit(describe, handle, priority=self._soon)
            value = await self._pool.fetch(described)
        self._drop([described])
        return handle, value

    async def _spread(
        self,
        total: int,
        largest: int,
        cut: Stage,
        stage: Stage,
        source: Any,
        on_done: Callable[[int], object] = lambda _: None,
    ) -> list[Any]:
        """Run a stage over ``total`` units of ``source`` in batches; return the handles in order.

        Only a few batches are queued at one time. The rest stays here, so that a new request
        finds short queues, a cancelled one leaves little behind, and the scheduler's own work
        stays in proportion.
        """
        workers = max(1, self._pool.warm_workers)
        size = max(1, min(largest, -(-total // workers)))
        window = 2 * workers
        starts = iter(range(0, total, size))
        results: dict[int, Any] = {}
        waiting: dict[asyncio.Task[None], int] = {}
        remaining = total

        def launch(start: int, priority: float) -> None:
            stop = min(start + size, total)
            part = self._submit(cut, source, start, stop, priority=priority)
            # Only the first pass counts as a patch; landing works on the points that it placed.
            patches = stop - start if stage == "predict" else 0
            result = self._submit(
                stage, part, self._order.model, priority=priority, patches=patches
            )
            self._drop([part])
            results[start] = result
            waiting[asyncio.create_task(self._pool.wait(result))] = stop - start

        try:
            while True:
                while len(waiting) < window and (start := next(starts, None)) is not None:
                    launch(start, self._base - remaining)
                if not waiting:
                    return [results[start] for start in sorted(results)]
                done, _ = await asyncio.wait(
                    waiting, timeout=_PATIENCE_S, return_when=asyncio.FIRST_COMPLETED
                )
                if not done and len(waiting) < 2 * window:
                    start = next(starts, None)
                    if start is not None:
                        # In a background order too: its batch goes ahead of all waiting batches
                        # of requests. That is intended: one each _PATIENCE_S, so that jobs
                        # progress at all while requests keep all workers busy.
                        launch(start, _FIRST)
                for task in done:
                    task.result()
                    count = waiting.pop(task)
                    remaining -= count
                    on_done(count)
        finally:
            for task in waiting:
                task.cancel()
            # Two may fail at once; nobody else would ask the second for its error.
            await asyncio.gather(*waiting, return_exceptions=True)

    async def _collect(self, written: Any, sheet: Sheet) -> Spool:
        """Bring the answer here, a chunk at a time, so that no worker waits for a slow client."""
        with disk():
            spool = Spool(self._spool_dir)
        try:
            with disk():
                await spool.write(sheet.first)
            for index in range(1, sheet.chunks):
                handle = self._submit("chunk", written, index, priority=self._soon)
                data = await self._pool.fetch(handle)
                with disk():
                    await spool.write(data)
                self._drop([handle])
            with disk():
                # A disk without room must show before the answer begins.
                await spool.flush()
        except BaseException:
            spool.close()
            raise
        return spool

    def _submit(
        self,
        stage: Stage,
        *args: Any,
        priority: float,
        long: bool = False,
        patches: int = 0,
    ) -> Any:
        left = self._ends - time.monotonic()
        handle = self._pool.submit(
            stage, *args, priority=priority, seconds=left, long=long, patches=patches
        )
        self._handles.add(handle)
        return handle

    def _drop(self, handles: list[Any]) -> None:
        """Let results go that nothing but tasks already submitted needs."""
        self._pool.release(handles)
        self._handles.difference_update(handles)


class _Free:
    async def __aenter__(self) -> None:
        return None

    async def __aexit__(self, *_: object) -> None:
        return None


_free = _Free()
