# SPDX-License-Identifier: Apache-2.0
"""The graph of tasks of one request, from the bytes of its body to the bytes of its answer."""

import asyncio
import itertools
import time
from collections import deque
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from pugeo_service.engine.backend import Pool
from pugeo_service.engine.collector import Collector
from pugeo_service.engine.dispatch import Dispatch, Where
from pugeo_service.engine.errors import disk
from pugeo_service.engine.messages import Head, Order, Outcome, Readable, Sheet, Watcher
from pugeo_service.engine.scheduling import LARGE_PATCHES, Lanes
from pugeo_service.storage.spool import Spool

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
            WorkerLostError, EngineLostError: see the pool.
            DiskError: the body cannot be read, or there is no room for the answer.
        """
        with disk():
            spool = Spool(self._spool_dir)
        try:
            async with AsyncExitStack() as inside:
                return await self._run(body, spool, inside)
        except BaseException:
            spool.close()
            raise
        finally:
            self._lanes.leave(self)
            self._tasks.cancel()

    async def _run(self, body: Readable, spool: Spool, inside: AsyncExitStack) -> Outcome:
        order, tally, began = self._order, _Tally(), time.perf_counter()

        size = order.estimate(body.size, order.format)
        head: Head
        # Of jobs, few enough run at one time already.
        if size >= LARGE_PATCHES and not order.background:
            await inside.enter_async_context(self._lanes.entrance)
        self._lanes.stand(self, size, background=order.background)
        self._watcher.on_stage("prepare")
        with disk():
            data = await body.read()
        answer = Collector(spool, await spool.share(), self._tasks)
        if self._tasks.everyone_is_busy and not order.background:
            order = replace(order, at_once_patches=LARGE_PATCHES - 1)
        prepared, head = await self._tasks.step(
            size, "prepare", "describe_prepared", data, order, asking=(answer.file,)
        )
        # The pool has its own copy, for as long as it may have to begin anew.
        del data
        tally.add(queue=0.0)
        tally.add(*head.batches, **head.seconds)
        if head.sheet is not None:
            tally.add(*head.sheet.batches, **head.sheet.seconds)
        tally.add(queue=time.perf_counter() - began - sum(tally.seconds.values()))
        size = head.patches
        self._lanes.stand(self, size, background=order.background)
        self._watcher.on_patches(size)
        if size < LARGE_PATCHES:
            await inside.aclose()

        sheet: Sheet
        if head.sheet is not None:
            self._watcher.on_done(size)
            written, sheet = prepared, head.sheet
            if not sheet.whole:
                written = self._tasks.submit("at_once", prepared)
        elif head.tiles == 1:
            prepared, charted = await self._predicted(prepared, head, tally)
            self._watcher.on_stage("finish")
            written, sheet = await self._tasks.step(
                size,
                "finish",
                "describe_written",
                prepared,
                charted,
                order.model,
                order.answer,
                asking=(answer.file,),
            )
            self._tasks.drop(charted)
            tally.add(*sheet.batches, **sheet.seconds)
        else:
            pieces = await self._tiled(prepared, head.tiles, tally)
            self._watcher.on_stage("finish")
            if head.by_rows:
                return await self._by_rows(prepared, pieces, answer, tally)
            written, sheet = await self._tasks.step(
                size,
                "assemble",
                "describe_written",
                prepared,
                pieces,
                order.answer,
                asking=(answer.file,),
            )
            self._tasks.drop(pieces)
            tally.add(**sheet.seconds)
        self._tasks.drop([prepared])

        self._watcher.on_stage("collect")
        began = time.perf_counter()
        await answer.collect(written, sheet)
        await answer.flush()
        tally.add(collect=time.perf_counter() - began)
        return Outcome(answer.spool, sheet.report, tally.seconds, tally.batches)

    async def _tiled(
        self,
        prepared: Any,
        tiles: int,
        tally: "_Tally",
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
                tally.add(**head.seconds)
                job, charted = await self._predicted(job, head, tally, where)
                self._watcher.on_stage("finish")
                pieces[number], (spent, ran) = await self._tasks.step(
                    LARGE_PATCHES,
                    "finish_tile",
                    "describe_finished",
                    job,
                    charted,
                    self._order.model,
                    place=where(),
                )
                tally.add(*ran, **spent)
                self._tasks.drop([job, *charted])
            busy.discard(place or "")

        tasks = [asyncio.create_task(lane(place)) for place in places or (None,)]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return pieces

    async def _predicted(
        self,
        prepared: Any,
        head: Head,
        tally: "_Tally",
        where: Where = lambda: None,
    ) -> tuple[Any, list[Any]]:
        """From patches to charts.

        Returns:
            The handle of what was prepared, which is another where it was noisy, and those of the
            charts.
        """
        self._watcher.on_stage("predict")
        began, size = time.perf_counter(), head.patches
        charted = await self._tasks.predict(prepared, size, where, self._watcher.on_done)
        if head.noisy:
            again, head = await self._tasks.step(
                size,
                "denoise",
                "describe_prepared",
                prepared,
                charted,
                self._order.model,
                place=where(),
            )
            if head.noisy:
                self._tasks.drop([again])
            else:
                tally.add(*head.batches)
                self._tasks.drop([prepared, *charted])
                prepared = again
                charted = await self._tasks.predict(prepared, size, where)
        tally.add(predict=time.perf_counter() - began)
        return prepared, charted

    async def _by_rows(
        self,
        prepared: Any,
        pieces: list[Any],
        answer: Collector,
        tally: "_Tally",
    ) -> Outcome:
        """Write the tiles one by one, each where it is, and bring them here in order."""
        said = [self._tasks.submit("border", piece) for piece in pieces]
        agreed, (report, spent) = await self._tasks.step(
            LARGE_PATCHES, "agree", "describe_agreed", prepared, said, self._order.answer
        )
        self._tasks.drop([prepared, *said])
        tally.add(finish=spent)

        self._watcher.on_stage("collect")
        began, waited = time.perf_counter(), 0.0

        async def write(number: int, piece: Any) -> tuple[Any, Sheet]:
            written = await self._tasks.step(
                LARGE_PATCHES,
                "write_tile",
                "describe_written",
                piece,
                agreed,
                number,
                # Where in the file it goes is known when the tiles before it are.
                asking=(None,),
            )
            self._tasks.drop([piece])
            return written

        # The workers write while what they wrote before is brought here.
        window = min(self._pool.warm_workers, _WRITERS) + 1
        waiting = enumerate(pieces)
        writing: deque[asyncio.Task[tuple[Any, Sheet]]] = deque()
        try:
            while True:
                for each in itertools.islice(waiting, window - len(writing)):
                    writing.append(asyncio.create_task(write(*each)))
                if not writing:
                    break
                asked = time.perf_counter()
                written, sheet = await writing.popleft()
                waited += time.perf_counter() - asked
                tally.add(**sheet.seconds)
                await answer.collect(written, sheet)
                self._tasks.drop([written])
        finally:
            for task in writing:
                task.cancel()
            await asyncio.gather(*writing, return_exceptions=True)
        await answer.flush()
        self._tasks.drop([agreed])
        tally.add(collect=time.perf_counter() - began - waited)
        return Outcome(answer.spool, report, tally.seconds, tally.batches)


class _Tally:
    """What a request took so far.

    Attributes:
        seconds: of each stage, in the order in which they were told of.
        batches: seconds and patches of each batch that the network ran.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.batches: list[tuple[float, int]] = []

    def add(self, *batches: tuple[float, int], **seconds: float) -> None:
        """Add to both."""
        self.batches += batches
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
