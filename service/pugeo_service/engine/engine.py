# SPDX-License-Identifier: Apache-2.0
"""The engine: a pool of workers with an event loop of its own.

Dask's scheduler works in an event loop. It gets one in its own thread, so that however busy it
is, the loop that answers requests and probes is not.
"""

import asyncio
import threading
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from pugeo_service.engine.backend import Pool
from pugeo_service.engine.dask_backend import DaskPool
from pugeo_service.engine.errors import EngineLostError, WorkerLostError
from pugeo_service.engine.messages import InMemory, Order, Outcome, Readable, Watcher
from pugeo_service.engine.orchestrator import Flow
from pugeo_service.engine.sample import sample_body, sample_order
from pugeo_service.engine.scheduling import Lanes
from pugeo_service.settings import Settings

__all__ = ["Engine", "Status"]

T = TypeVar("T")


@dataclass(frozen=True)
class Status:
    """The state of the engine, cheap to ask for.

    Attributes:
        workers: warm workers; none before the engine proved itself.
        expected: workers that there should be, or ``None`` where they run elsewhere.
        lost: workers seen to end without being told to; one that comes and goes between two looks
            is not seen.
        retried: patches begun once more because a worker was lost.
    """

    workers: int
    expected: int | None
    lost: int
    retried: int


class Engine:
    """Runs orders. Its public methods belong to the event loop of the front.

    Args:
        settings: which pool and how large.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._pool = _make_pool(settings)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        # Suspects run one at a time: the guilty one then ends nobody else's task.
        self._quarantine = asyncio.Lock()
        self._lanes = Lanes(lambda: self._pool.warm_workers)
        self._proven = False
        self._retried = 0

    async def start(self) -> None:
        """Start the workers; returns once a small request of our own went all the way."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="engine", daemon=True)
        self._thread.start()
        await self._call(self._pool.start())
        await self._call(self._prove())
        self._proven = True

    async def stop(self) -> None:
        """End the workers and the thread."""
        if self._loop is None or self._thread is None:
            return
        await self._call(self._pool.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        await asyncio.to_thread(self._thread.join)
        self._loop.close()
        self._loop = self._thread = None

    @property
    def status(self) -> Status:
        """The state of the workers, at most half a second old."""
        expected = self._settings.worker_count if self._settings.scheduler is None else None
        warm = self._pool.warm_workers if self._proven else 0
        retried = self._pool.retried_patches + self._retried
        return Status(warm, expected, self._pool.lost_workers, retried)

    async def run(
        self,
        body: Readable,
        order: Order,
        *,
        on_patches: Callable[[int], object],
        on_done: Callable[[int], object],
        on_stage: Callable[[str], object] = lambda _: None,
    ) -> Outcome:
        """Run an order to its end; cancelling this cancels its tasks.

        Args:
            body: the request's bytes; they are read when the engine begins.
            order: what to do.
            on_patches: is told the number of patches, in the caller's event loop.
            on_done: is told how many patches more are done, in the caller's event loop.
            on_stage: is told which stage begins, in the caller's event loop.

        Raises:
            CloudError: the input cannot be used.
            WorkerLostError: it ended worker processes, even when run alone.
            EngineLostError: the scheduler is gone.
            DiskError: the body cannot be read, or there is no room for the answer.
        """
        here = asyncio.get_running_loop()
        watcher = Watcher(
            lambda count: here.call_soon_threadsafe(on_patches, count),
            lambda count: here.call_soon_threadsafe(on_done, count),
            lambda stage: here.call_soon_threadsafe(on_stage, stage),
        )
        return await self._call(self._run(body, order, watcher))

    async def _prove(self) -> None:
        order = sample_order(self._settings.model, self._settings.deadline_s)
        flow = Flow(self._pool, order, self._lanes, Watcher(), self._settings.spool_dir)
        (await flow.run(InMemory(sample_body()))).spool.close()

    async def _run(self, body: Readable, order: Order, watcher: Watcher) -> Outcome:
        done = 0

        def on_done(count: int) -> None:
            nonlocal done
            done += count
            watcher.on_done(count)

        counting = replace(watcher, on_done=on_done)

        async def attempt() -> Outcome:
            flow = Flow(self._pool, order, self._lanes, counting, self._settings.spool_dir)
            return await flow.run(body)

        try:
            return await attempt()
        except (WorkerLostError, EngineLostError):
            # Perhaps a bystander: Dask suspects every task that was queued on a dead worker.
            self._retried += done
            async with self._quarantine:
                return await attempt()

    async def _call(self, work: Coroutine[Any, Any, T]) -> T:
        if self._loop is None:
            work.close()
            raise EngineLostError("the engine is not running")
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self._loop))


def _make_pool(settings: Settings) -> Pool:
    if settings.engine == "inline":
        # Here and not above: it brings the model and torch into this process.
        from pugeo_service.engine.inline_backend import InlinePool

        return InlinePool(settings)
    return DaskPool(settings)
