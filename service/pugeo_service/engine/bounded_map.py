# SPDX-License-Identifier: Apache-2.0
"""One stage over all parts of a cloud, a few at a time."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from pugeo_service.engine.scheduling import Lanes, Line

__all__ = ["Haste", "Spread"]


@dataclass(frozen=True)
class Haste:
    """How a cloud gets on beside others that go first.

    Attributes:
        turns: where its parts queue for turns, one at a time.
        patience: seconds without any part done, after which the next takes a turn.
        eager: parts that were not queued yet take turns without such patience.
    """

    turns: Line
    patience: float
    eager: bool


@dataclass(eq=False)
class _Part:
    start: int
    stop: int
    handle: Any
    waiter: asyncio.Task[None]


class Spread:
    """Runs ``total`` units in parts of ``size``.

    Only a few parts are queued at one time. The rest stays here, so that a new request finds
    short queues, a cancelled one leaves little behind, and the scheduler's own work stays in
    proportion.

    Args:
        total: units.
        size: of a part.
        submit: queues the part ``start, stop`` at a priority; returns the handle of its result.
        wait: waits for a handle.
        drop: lets the result of a handle go.
        on_done: is told how many units more are done.
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

    async def run(self, window: int, priority: float, haste: Haste | None) -> list[Any]:
        """Run all parts, ``window`` at a time; return the handles in the order of the parts.

        Args:
            window: parts queued at ``priority`` at one time.
            priority: of those without a turn.
            haste: where others go first; ``None`` where nobody is overtaken.
        """
        hurry = asyncio.create_task(self._hurry(haste)) if haste else None
        if hurry is not None:
            hurry.add_done_callback(lambda _: self._ended.put_nowait(None))
        try:
            while self._left:
                while self._fresh and len(self._queued) < window:
                    self._launch(*self._fresh.popleft(), priority)
                part = await self._ended.get()
                if part is None:
                    # It only ends early with an error, and with the part that it held.
                    assert hurry is not None
                    hurry.result()
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
            waiters += [hurry] if hurry else []
            for waiter in waiters:
                waiter.cancel()
            # Two may fail at once; nobody else would ask the second for its error.
            await asyncio.gather(*waiters, return_exceptions=True)

    def _launch(self, start: int, stop: int, priority: float) -> _Part:
        handle = self._submit(start, stop, priority)
        part = _Part(start, stop, handle, asyncio.create_task(self._wait(handle)))
        part.waiter.add_done_callback(lambda _: self._ended.put_nowait(part))
        self._queued[start] = part
        return part

    async def _hurry(self, haste: Haste) -> None:
        """Give parts turns, one after the other, until all are done."""
        while True:
            while not self._due(haste):
                since = time.monotonic() - self._last_done
                await asyncio.sleep(max(haste.patience - since, 0.0) + 0.01)
            async with haste.turns:
                # What was due may have been done while this waited.
                if self._due(haste):
                    part = self._next()
                    await asyncio.wait({part.waiter})

    def _due(self, haste: Haste) -> bool:
        if self._fresh and haste.eager:
            return True
        waits = bool(self._fresh or self._unfinished())
        return waits and time.monotonic() - self._last_done >= haste.patience

    def _unfinished(self) -> list[_Part]:
        return [part for part in self._queued.values() if not part.waiter.done()]

    def _next(self) -> _Part:
        """Queue the next part before all others, be it one that waits for long already."""
        if self._fresh:
            return self._launch(*self._fresh.popleft(), Lanes.FIRST)
        stuck = self._unfinished()[0]
        stuck.waiter.cancel()
        self._drop([stuck.handle])
        del self._queued[stuck.start]
        return self._launch(stuck.start, stuck.stop, Lanes.FIRST)
