# SPDX-License-Identifier: Apache-2.0
"""One stage over all parts of a tile, a bounded number of parts at a time."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from pugeo_service.engine.scheduling import FairSemaphore, SchedulingPolicy

__all__ = ["BoundedMap", "StarvationGuard"]


@dataclass(frozen=True)
class StarvationGuard:
    """Rules by which a cloud makes progress while other requests go first.

    Attributes:
        turns: semaphore of tasks that run before all others; parts take it one at a time.
        patience: seconds without a finished part after which the next part takes a turn.
        eager: parts that are not queued yet take turns without waiting so long.
    """

    turns: FairSemaphore
    patience: float
    eager: bool


@dataclass(eq=False)
class _Part:
    start: int
    stop: int
    handle: Any
    waiter: asyncio.Task[None]


class BoundedMap:
    """Runs ``total`` units in parts of ``size``, few of which are queued at a time.

    The others stay here, so that a new request finds short queues, a cancelled one leaves little
    behind, and the scheduler's own work stays in proportion.

    Args:
        total: units.
        size: of a part.
        submit: queues the part ``start, stop`` at a priority; returns the handle of its result.
        wait: waits for a handle.
        drop: drops the results of handles.
        on_done: is called with the number of units of each finished part.
    """

    def __init__(
        self,
        total: int,
        size: int,
        *,
        submit: Callable[[int, int, float], Any],
        wait: Callable[[Any], Coroutine[Any, Any, None]],
        drop: Callable[[list[Any]], None],
        on_done: Callable[[int], object],
    ) -> None:
        self._submit, self._wait, self._drop, self._on_done = submit, wait, drop, on_done
        self._fresh = deque((at, min(at + size, total)) for at in range(0, total, size))
        self._left = len(self._fresh)
        self._queued: dict[int, _Part] = {}
        self._ended: asyncio.Queue[_Part | None] = asyncio.Queue()
        self._results: dict[int, Any] = {}
        self._last_done = time.monotonic()

    async def run(self, window: int, priority: float, guard: StarvationGuard | None) -> list[Any]:
        """Run all parts; return their handles in order.

        Args:
            window: number of parts queued at ``priority`` at a time.
            priority: of parts without a turn.
            guard: needed if other requests have priority; otherwise ``None``.
        """
        guarding = asyncio.create_task(self._take_turns(guard)) if guard else None
        if guarding is not None:
            guarding.add_done_callback(lambda _: self._ended.put_nowait(None))
        try:
            while self._left:
                while self._fresh and len(self._queued) < window:
                    self._launch(*self._fresh.popleft(), priority)
                part = await self._ended.get()
                if part is None:
                    # The guard ends early only with an error, which this raises.
                    assert guarding is not None
                    guarding.result()
                    continue
                if self._queued.get(part.start) is not part:
                    continue
                part.waiter.result()
                del self._queued[part.start]
                self._results[part.start] = part.handle
                self._left -= 1
                self._last_done = time.monotonic()
                self._on_done(part.stop - part.start)
            return [self._results[start] for start in sorted(self._results)]
        finally:
            waiters = [part.waiter for part in self._queued.values()]
            waiters += [guarding] if guarding else []
            for waiter in waiters:
                waiter.cancel()
            # Two may fail at once; the error of the second would be reported as never retrieved.
            await asyncio.gather(*waiters, return_exceptions=True)

    def _launch(self, start: int, stop: int, priority: float) -> _Part:
        handle = self._submit(start, stop, priority)
        part = _Part(start, stop, handle, asyncio.create_task(self._wait(handle)))
        part.waiter.add_done_callback(lambda _: self._ended.put_nowait(part))
        self._queued[start] = part
        return part

    async def _take_turns(self, guard: StarvationGuard) -> None:
        """Give parts turns, one after the other, until all are done."""
        while True:
            while not self._due(guard):
                since = time.monotonic() - self._last_done
                await asyncio.sleep(max(guard.patience - since, 0.0) + 0.01)
            async with guard.turns:
                # The part may have finished while this waited for a turn.
                if self._due(guard):
                    part = self._next()
                    await asyncio.wait({part.waiter})

    def _due(self, guard: StarvationGuard) -> bool:
        if self._fresh and guard.eager:
            return True
        waits = bool(self._fresh or self._unfinished())
        return waits and time.monotonic() - self._last_done >= guard.patience

    def _unfinished(self) -> list[_Part]:
        return [part for part in self._queued.values() if not part.waiter.done()]

    def _next(self) -> _Part:
        """Queue the next part before all others; it may be one that has waited in the queue."""
        if self._fresh:
            return self._launch(*self._fresh.popleft(), SchedulingPolicy.FIRST)
        stuck = self._unfinished()[0]
        stuck.waiter.cancel()
        self._drop([stuck.handle])
        del self._queued[stuck.start]
        return self._launch(stuck.start, stuck.stop, SchedulingPolicy.FIRST)
