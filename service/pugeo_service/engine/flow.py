# SPDX-License-Identifier: Apache-2.0
"""The graph of tasks of one request, from the bytes of its body to the bytes of its answer."""

import asyncio
import itertools
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from pugeo_service.engine.dispatch import Dispatch, Where
from pugeo_service.engine.errors import disk
from pugeo_service.engine.lanes import LARGE_PATCHES, Lanes
from pugeo_service.engine.order import Head, Order, Outcome, Readable, Sheet, Watcher
from pugeo_service.engine.pool import Pool
from pugeo_service.spool import Spool

__all__ = ["Flow"]

_WRITERS = 3  # tiles written at one time: enough to keep the front busy


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
        self._tasks = Dispatch(pool, order, lanes)

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
            self._lanes.leave(self)
            self._tasks.cancel()

    async def _run(self, body: Readable, inside: AsyncExitStack) -> Outcome:
        order, seconds, began = self._order, {}, time.perf_counter()

        size = order.estimate(body.size, order.format)
        head: Head
        # Of jobs, few enough run at one time already.
        if size >= LARGE_PATCHES and not order.background:
            await inside.enter_async_context(self._lanes.entrance)
        self._lanes.stand(self, size, background=order.background)
        self._watcher.on_stage("prepare")
        with disk():
            data = await body.read()
        if self._tasks.everyone_is_busy and not order.background:
            order = replace(order, at_once_patches=LARGE_PATCHES - 1)
        prepared, head = await self._tasks.step(size, "prepare", "describe_prepared", data, order)
        # The pool has its own copy, for as long as it may have to begin anew.
        del data
        seconds["queue"] = time.perf_counter() - began - sum(head.seconds.values())
        seconds.update(head.seconds)
        size = head.patches
        self._lanes.stand(self, size, background=order.background)
        self._watcher.on_patches(size)
        if size < LARGE_PATCHES:
            await inside.aclose()

        sheet: Sheet
        batches = list(head.batches)
        if head.sheet is not None:
            self._watcher.on_done(size)
            written, sheet = prepared, head.sheet
            if sheet.chunks > 1:
                written = self._tasks.submit("at_once", prepared)
        elif head.tiles == 1:
            prepared, landed = await self._dense(prepared, head, seconds, batches)
            self._watcher.on_stage("finish")
            written, sheet = await self._tasks.step(
                size, "finish", "describe_written", prepared, landed, order.answer
            )
            self._tasks.drop(landed)
        else:
            pieces = await self._tiled(prepared, head.tiles, seconds, batches)
            self._watcher.on_stage("finish")
            if head.by_rows:
                return await self._by_rows(prepared, pieces, seconds, batches)
            written, sheet = await self._tasks.step(
                size, "assemble", "describe_written", prepared, pieces, order.answer
            )
            self._tasks.drop(pieces)
        _add(seconds, sheet.seconds)
        self._tasks.drop([prepared])

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

        Each worker has tiles of its own, which saves carrying their patches about. Once one has
        none left it helps the others.

        Returns:
            The handles of their pieces, in order.
        """
        pieces: list[Any] = [None] * tiles
        numbers = iter(range(tiles))
        places = self._pool.places
        busy = set(places)

        async def lane(place: str | None) -> None:
            def where() -> str | None:
                return place if len(busy) == len(places) else None

            for number in numbers:
                tile = self._tasks.submit("cut_tile", prepared, number)
                head: Head
                job, head = await self._tasks.step(
                    LARGE_PATCHES, "prepare_tile", "describe_prepared", tile, place=where()
                )
                self._tasks.drop([tile])
                _add(seconds, head.seconds)
                job, landed = await self._dense(job, head, seconds, batches, where)
                self._watcher.on_stage("finish")
                pieces[number], spent = await self._tasks.step(
                    LARGE_PATCHES, "finish_tile", "describe_finished", job, landed, place=where()
                )
                _add(seconds, {"finish": spent})
                self._tasks.drop([job, *landed])
            busy.discard(place or "")

        tasks = [asyncio.create_task(lane(place)) for place in places or (None,)]
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
        head: Head,
        seconds: dict[str, float],
        batches: list[tuple[float, int]],
        where: Where = lambda: None,
    ) -> tuple[Any, list[Any]]:
        """From patches to points on the surface.

        Returns:
            The handle of what was prepared, which is another where it was noisy, and those of the
            points.
        """
        self._watcher.on_stage("predict")
        began, size = time.perf_counter(), head.patches
        charted = await self._tasks.spread(
            size, size, "predict_part", prepared, where, self._watcher.on_done
        )
        _add(seconds, {"predict": time.perf_counter() - began})

        if head.noisy:
            began = time.perf_counter()
            spots, (landings, _, ran) = await self._tasks.step(
                size, "own_spots", "describe_merged", prepared, charted, place=where()
            )
            landed = await self._tasks.spread(size, landings, "land_part", spots, where)
            again, head = await self._tasks.step(
                size, "denoise", "describe_prepared", prepared, landed, place=where()
            )
            self._tasks.drop([spots, *landed])
            if head.noisy:
                self._tasks.drop([again])
            else:
                batches += ran
                self._tasks.drop([prepared, *charted])
                prepared = again
                charted = await self._tasks.spread(size, size, "predict_part", prepared, where)
            _add(seconds, {"predict": time.perf_counter() - began})

        self._watcher.on_stage("land")
        proposed, (landings, proposing, ran) = await self._tasks.step(
            size, "propose", "describe_merged", prepared, charted, place=where()
        )
        batches += ran
        began = time.perf_counter()
        candidates = await self._tasks.spread(size, landings, "land_part", proposed, where)
        self._tasks.drop([proposed])
        _add(seconds, {"land": time.perf_counter() - began})

        self._watcher.on_stage("merge")
        merged, (landings, merging, _) = await self._tasks.step(
            size, "merge", "describe_merged", prepared, charted, candidates, place=where()
        )
        _add(seconds, {"merge": proposing + merging})
        self._tasks.drop([*charted, *candidates])

        self._watcher.on_stage("land")
        began = time.perf_counter()
        landed = await self._tasks.spread(size, landings, "land_part", merged, where)
        _add(seconds, {"land": time.perf_counter() - began})
        self._tasks.drop([merged])
        return prepared, landed

    async def _by_rows(
        self,
        prepared: Any,
        pieces: list[Any],
        seconds: dict[str, float],
        batches: list[tuple[float, int]],
    ) -> Outcome:
        """Write the tiles one by one, each where it is, and bring them here in order."""
        said = [self._tasks.submit("border", piece) for piece in pieces]
        agreed, (report, spent) = await self._tasks.step(
            LARGE_PATCHES, "agree", "describe_agreed", prepared, said, self._order.answer
        )
        self._tasks.drop([prepared, *said])
        _add(seconds, {"finish": spent})

        self._watcher.on_stage("collect")
        began, waited = time.perf_counter(), 0.0

        writing: deque[asyncio.Task[tuple[Any, Sheet]]] = deque()

        async def write(number: int, piece: Any) -> tuple[Any, Sheet]:
            written = await self._tasks.step(
                LARGE_PATCHES, "write_tile", "describe_written", piece, agreed, number
            )
            self._tasks.drop([piece])
            return written

        async def chunks() -> AsyncIterator[bytes]:
            nonlocal waited
            waiting = enumerate(pieces)
            # The workers write while what they wrote before is brought here; the front holds the
            # first chunk of each.
            window = min(self._pool.warm_workers, _WRITERS) + 1
            while True:
                for each in itertools.islice(waiting, window - len(writing)):
                    writing.append(asyncio.create_task(write(*each)))
                if not writing:
                    return
                asked = time.perf_counter()
                written, sheet = await writing.popleft()
                waited += time.perf_counter() - asked
                _add(seconds, sheet.seconds)
                async for data in self._chunks(written, sheet):
                    yield data
                self._tasks.drop([written])

        try:
            spool = await self._spooled(chunks())
        finally:
            for task in writing:
                task.cancel()
            await asyncio.gather(*writing, return_exceptions=True)
        self._tasks.drop([agreed])
        seconds["collect"] = time.perf_counter() - began - waited
        return Outcome(spool, report, seconds, batches)

    async def _chunks(self, written: Any, sheet: Sheet) -> AsyncIterator[bytes]:
        """Bring bytes here, a chunk at a time: little is in memory whatever the size."""
        yield sheet.first
        for index in range(1, sheet.chunks):
            handle = self._tasks.submit("chunk", written, index)
            yield await self._tasks.fetch(handle)
            self._tasks.drop([handle])

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


def _add(seconds: dict[str, float], more: dict[str, float]) -> None:
    for stage, spent in more.items():
        seconds[stage] = seconds.get(stage, 0.0) + spent
