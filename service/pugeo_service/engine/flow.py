# SPDX-License-Identifier: Apache-2.0
"""The graph of tasks of one request, from the bytes of its body to the bytes of its answer."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from pugeo_service.engine.errors import disk
from pugeo_service.engine.lanes import LARGE_PATCHES, Lanes
from pugeo_service.engine.order import Head, Order, Outcome, Readable, Sheet, Watcher
from pugeo_service.engine.pool import Pool, Stage
from pugeo_service.engine.spread import Haste, Spread
from pugeo_service.spool import Spool

__all__ = ["Flow"]

# A cloud that others overtake, and that got nothing done for so long, is helped along.
_PATIENCE_S = 2.0
_BACKGROUND_PATIENCE_S = 5.0


class Flow:
    """One request on its way through the pool.

    Args:
        pool: where the tasks run.
        order: what to do.
        lanes: who goes first among all requests of the engine.
        watcher: who is told how far it is.
        spool_dir: folder for the answer.
    """

    def __init__(
        self,
        pool: Pool,
        order: Order,
        lanes: Lanes,
        watcher: Watcher,
        spool_dir: Path,
    ) -> None:
        self._pool = pool
        self._order = order
        self._lanes = lanes
        self._watcher = watcher
        self._spool_dir = spool_dir
        self._came = time.monotonic()
        self._ends = self._came + order.deadline_s
        self._handles: set[Any] = set()

    async def run(self, body: Readable) -> Outcome:
        """Do it.

        Args:
            body: its bytes are read once this may begin.

        Raises:
            CloudError: the input cannot be used.
            WorkerLost, EngineLost: see the pool.
            DiskFailed: the body cannot be read, or there is no room for the answer.
        """
        try:
            async with AsyncExitStack() as inside:
                return await self._run(body, inside)
        finally:
            self._pool.cancel(self._handles)

    async def _run(self, body: Readable, inside: AsyncExitStack) -> Outcome:
        order, seconds, began = self._order, {}, time.perf_counter()

        size = order.estimate(body.size, order.format)
        head: Head
        # Of jobs, few enough run at one time already.
        if size >= LARGE_PATCHES and not order.background:
            await inside.enter_async_context(self._lanes.entrance)
        self._watcher.on_stage("prepare")
        with disk():
            data = await body.read()
        prepared, head = await self._step(size, "prepare", "describe_prepared", data, order)
        # The pool has its own copy, for as long as it may have to begin anew.
        del data
        seconds["queue"] = time.perf_counter() - began - sum(head.seconds.values())
        seconds.update(head.seconds)
        size = head.patches
        self._watcher.on_patches(size)
        if size < LARGE_PATCHES:
            await inside.aclose()

        sheet: Sheet
        batches = list(head.batches)
        if head.sheet is not None:
            self._watcher.on_done(size)
            written, sheet = prepared, head.sheet
            if sheet.chunks > 1:
                written = self._submit("at_once", prepared, priority=Lanes.FIRST)
        elif head.tiles == 1:
            landed = await self._dense(prepared, size, seconds, batches)
            self._watcher.on_stage("finish")
            written, sheet = await self._step(
                size, "finish", "describe_written", prepared, landed, order.answer
            )
            self._drop(landed)
        else:
            pieces = await self._tiled(prepared, head.tiles, seconds, batches)
            self._watcher.on_stage("finish")
            if head.by_rows:
                return await self._by_rows(prepared, pieces, seconds, batches)
            written, sheet = await self._step(
                size, "assemble", "describe_written", prepared, pieces, order.answer
            )
            self._drop(pieces)
        _add(seconds, sheet.seconds)
        self._drop([prepared])

        self._watcher.on_stage("collect")
        began = time.perf_counter()
        spool = await self._spooled(self._chunks(written, sheet))
        seconds["collect"] = time.perf_counter() - began
        return Outcome(spool, sheet.report, seconds, batches)

    async def _tiled(
        self,
        prepared: Any,
        tiles: int,
        seconds: dict[str, float],
        batches: list[tuple[float, int]],
    ) -> list[Any]:
        """Run the tiles of a cloud, as many at one time as there are workers.

        While one of them is in a stage that one worker does alone, the others keep the rest busy.

        Returns:
            The handles of their pieces, in order.
        """
        pieces: list[Any] = [None] * tiles
        numbers = iter(range(tiles))

        async def lane() -> None:
            for number in numbers:
                tile = self._submit("cut_tile", prepared, number, priority=Lanes.FIRST)
                head: Head
                job, head = await self._step(
                    LARGE_PATCHES, "prepare_tile", "describe_prepared", tile
                )
                self._drop([tile])
                _add(seconds, head.seconds)
                landed = await self._dense(job, head.patches, seconds, batches)
                self._watcher.on_stage("finish")
                pieces[number], spent = await self._step(
                    LARGE_PATCHES, "finish_tile", "describe_finished", job, landed
                )
                _add(seconds, {"finish": spent})
                self._drop([job, *landed])

        tasks = [asyncio.create_task(lane()) for _ in range(max(1, self._pool.warm_workers))]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return pieces

    async def _dense(
        self,
        prepared: Any,
        size: int,
        seconds: dict[str, float],
        batches: list[tuple[float, int]],
    ) -> list[Any]:
        """From patches to points on the surface; return the handles of these."""
        self._watcher.on_stage("predict")
        began = time.perf_counter()
        charted = await self._spread(
            size, size, "cut_patches", "predict", prepared, self._watcher.on_done
        )
        _add(seconds, {"predict": time.perf_counter() - began})

        self._watcher.on_stage("land")
        proposed, (landings, proposing, ran) = await self._step(
            size, "propose", "describe_merged", prepared, charted
        )
        batches += ran
        began = time.perf_counter()
        candidates = await self._spread(size, landings, "cut_landings", "land", proposed)
        self._drop([proposed])
        _add(seconds, {"land": time.perf_counter() - began})

        self._watcher.on_stage("merge")
        merged, (landings, merging, _) = await self._step(
            size, "merge", "describe_merged", prepared, charted, candidates
        )
        _add(seconds, {"merge": proposing + merging})
        self._drop([*charted, *candidates])

        self._watcher.on_stage("land")
        began = time.perf_counter()
        landed = await self._spread(size, landings, "cut_landings", "land", merged)
        _add(seconds, {"land": time.perf_counter() - began})
        self._drop([merged])
        return landed

    async def _by_rows(
        self,
        prepared: Any,
        pieces: list[Any],
        seconds: dict[str, float],
        batches: list[tuple[float, int]],
    ) -> Outcome:
        """Write the tiles one by one, each where it is, and bring them here in order."""
        said = [self._submit("sides", piece, priority=Lanes.FIRST) for piece in pieces]
        agreed, (report, spent) = await self._step(
            LARGE_PATCHES, "agree", "describe_agreed", prepared, said, self._order.answer
        )
        self._drop([prepared, *said])
        _add(seconds, {"finish": spent})

        self._watcher.on_stage("collect")
        began, waited = time.perf_counter(), 0.0

        async def chunks() -> AsyncIterator[bytes]:
            nonlocal waited
            for number, piece in enumerate(pieces):
                asked = time.perf_counter()
                sheet: Sheet
                written, sheet = await self._step(
                    LARGE_PATCHES, "write_tile", "describe_written", piece, agreed, number
                )
                waited += time.perf_counter() - asked
                self._drop([piece])
                _add(seconds, sheet.seconds)
                async for data in self._chunks(written, sheet):
                    yield data
                self._drop([written])

        spool = await self._spooled(chunks())
        self._drop([agreed])
        seconds["collect"] = time.perf_counter() - began - waited
        return Outcome(spool, report, seconds, batches)

    async def _step(self, size: int, stage: Stage, describe: Stage, *args: Any) -> tuple[Any, Any]:
        """Run a stage of the whole cloud; return the handle of its result and a description."""
        if size >= LARGE_PATCHES:
            async with self._lanes.turns:
                return await self._ask(Lanes.FIRST, stage, describe, *args, long=True)
        if not self._order.background:
            return await self._ask(self._priority(size), stage, describe, *args)
        try:
            async with asyncio.timeout(_BACKGROUND_PATIENCE_S):
                return await self._ask(self._priority(size), stage, describe, *args)
        except TimeoutError:
            # It takes no second once it runs, so it did not.
            return await self._ask(Lanes.FIRST, stage, describe, *args)

    async def _ask(
        self, priority: float, stage: Stage, describe: Stage, *args: Any, long: bool = False
    ) -> tuple[Any, Any]:
        handle = self._submit(stage, *args, priority=priority, long=long)
        # Queued right away: a question asked later would cost another round trip.
        described = self._submit(describe, handle, priority=Lanes.FIRST)
        try:
            value = await self._pool.fetch(described)
        except asyncio.CancelledError:
            self._drop([handle])
            raise
        finally:
            self._drop([described])
        return handle, value

    async def _spread(
        self,
        patches: int,
        total: int,
        cut: Stage,
        stage: Stage,
        source: Any,
        on_done: Callable[[int], object] = lambda _: None,
    ) -> list[Any]:
        """Run a stage over ``total`` units of ``source``; return the handles in order."""

        def submit(start: int, stop: int, priority: float) -> Any:
            part = self._submit(cut, source, start, stop, priority=priority)
            # Only the first pass counts as a patch; landing works on the points that it placed.
            count = stop - start if stage == "predict" else 0
            result = self._submit(stage, part, self._order.model, priority=priority, patches=count)
            self._drop([part])
            return result

        workers = max(1, self._pool.warm_workers)
        haste = None
        if self._order.background:
            haste = Haste(self._lanes.turns, _BACKGROUND_PATIENCE_S, eager=False)
        elif patches >= LARGE_PATCHES:
            haste = Haste(self._lanes.turns, _PATIENCE_S, eager=True)
        spread = Spread(
            total,
            max(1, min(self._order.batch_patches, -(-total // workers))),
            submit=submit,
            wait=self._pool.wait,
            drop=self._drop,
            on_done=on_done,
        )
        return await spread.run(2 * workers, self._priority(patches), haste)

    def _priority(self, patches: int) -> float:
        return Lanes.priority(self._came, patches, background=self._order.background)

    async def _chunks(self, written: Any, sheet: Sheet) -> AsyncIterator[bytes]:
        """Bring bytes here, a chunk at a time: little is in memory whatever the size."""
        yield sheet.first
        for index in range(1, sheet.chunks):
            handle = self._submit("chunk", written, index, priority=Lanes.FIRST)
            yield await self._pool.fetch(handle)
            self._drop([handle])

    async def _spooled(self, parts: AsyncIterator[bytes]) -> Spool:
        """Put all on disk here, so that no worker waits for a slow client."""
        with disk():
            spool = Spool(self._spool_dir)
        try:
            async for data in parts:
                with disk():
                    await spool.write(data)
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


def _add(seconds: dict[str, float], more: dict[str, float]) -> None:
    for stage, spent in more.items():
        seconds[stage] = seconds.get(stage, 0.0) + spent
