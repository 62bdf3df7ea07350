# SPDX-License-Identifier: Apache-2.0
"""How the tasks of one request reach the workers: when, and on which of them.

Left alone, Dask runs a task where the results are that it needs: all of a request would stay on one
worker. Parts of a stage are therefore given a place each.
"""

import asyncio
import functools
import time
from collections.abc import Callable
from typing import Any

from pugeo_service.engine.backend import Pool, Stage
from pugeo_service.engine.bounded_map import Haste, Spread
from pugeo_service.engine.messages import Order
from pugeo_service.engine.scheduling import LARGE_PATCHES, Lanes

__all__ = ["Dispatch", "Where"]

Where = Callable[[], str | None]
"""The worker that has what a task needs, where no other should do it."""

# A cloud that others overtake, and that got nothing done for so long, is helped along.
_PATIENCE_S = 2.0
_BACKGROUND_PATIENCE_S = 5.0
# Patches in one task, where they stay where they are: 0.2 s, which is what a small cloud waits.
_PART = 3


class Dispatch:
    """The tasks of a request.

    Args:
        pool: where they run.
        order: what to do.
        lanes: who goes first among all requests of the engine.
    """

    def __init__(self, pool: Pool, order: Order, lanes: Lanes) -> None:
        self._pool = pool
        self._order = order
        self._lanes = lanes
        self._came = time.monotonic()
        self._ends = self._came + order.deadline_s
        self._handles: set[Any] = set()
        self._places: dict[Any, str] = {}

    def submit(
        self,
        stage: Stage,
        *args: Any,
        priority: float = Lanes.FIRST,
        long: bool = False,
        patches: int = 0,
        place: str | None = None,
    ) -> Any:
        """Queue a task; see ``Pool.submit``."""
        left = self._ends - time.monotonic()
        handle = self._pool.submit(
            stage, *args, priority=priority, seconds=left, long=long, patches=patches, place=place
        )
        self._handles.add(handle)
        return handle

    async def fetch(self, handle: Any) -> Any:
        """Wait for a result and bring it here."""
        return await self._pool.fetch(handle)

    def drop(self, handles: list[Any]) -> None:
        """Let results go that nothing but tasks already submitted needs."""
        self._pool.release(handles)
        self._handles.difference_update(handles)

    def cancel(self) -> None:
        """Let all results go, and drop whatever has not begun yet."""
        self._pool.cancel(self._handles)
        # Of parts nobody had begun to wait for, too.
        for handle in list(self._places):
            self._over(handle)

    @property
    def everyone_is_busy(self) -> bool:
        """Whether each worker has a request: spreading one over all of them gains nothing then."""
        return len(self._lanes.requests) >= self._pool.warm_workers

    async def step(
        self,
        size: int,
        stage: Stage,
        describe: Stage,
        *args: Any,
        place: str | None = None,
        asking: tuple[Any, ...] = (),
    ) -> tuple[Any, Any]:
        """Run a stage that one worker does alone.

        Args:
            size: patches of the cloud.
            stage: its name.
            describe: the stage that tells the front of its result.
            args: of the stage.
            place: where to run it; where most of ``args`` are if ``None``.
            asking: arguments of ``describe`` besides the result.

        Returns:
            The handle of its result, and the description.
        """
        ask = functools.partial(self._ask, stage, args, describe, asking)
        if size >= LARGE_PATCHES:
            async with self._lanes.turns:
                return await ask(Lanes.FIRST, long=True, place=place)
        if not self._order.background:
            return await ask(self._priority(size))
        try:
            async with asyncio.timeout(_BACKGROUND_PATIENCE_S):
                return await ask(self._priority(size))
        except TimeoutError:
            # It takes about a second once it runs, so it hardly did; and may run twice.
            return await ask(Lanes.FIRST)

    async def predict(
        self,
        prepared: Any,
        patches: int,
        where: Where = lambda: None,
        on_done: Callable[[int], object] = lambda _: None,
    ) -> list[Any]:
        """Run the patches of a cloud or a tile through the network, in parts.

        Args:
            prepared: handle of it.
            patches: of it.
            where: asked for each part: the worker that has ``prepared``, if all is to stay there.
            on_done: is told how many patches more are done.

        Returns:
            The handles of the parts' results, in order.
        """
        model = self._order.model

        def carried() -> bool:
            return where() is None and not self.everyone_is_busy

        def submit(start: int, stop: int, priority: float) -> Any:
            place, count = where(), stop - start
            if carried():
                place = self._lanes.emptiest(self._pool.places)
                part = self.submit("cut_patches", prepared, start, stop, priority=priority)
                result = self.submit(
                    "predict", part, model, priority=priority, patches=count, place=place
                )
                self.drop([part])
            else:
                span = (prepared, start, stop, model)
                result = self.submit(
                    "predict_part", *span, priority=priority, patches=count, place=place
                )
            if place is not None:
                self._lanes.load[place] += 1
                self._places[result] = place
            return result

        workers = max(1, self._pool.warm_workers)
        size = self._order.batch_patches
        # Parts for all workers, where they are carried to them.
        size = min(size, -(-patches // workers)) if carried() else max(size, _PART)
        haste = None
        if self._order.background:
            haste = Haste(self._lanes.turns, _BACKGROUND_PATIENCE_S, eager=False)
        elif patches >= LARGE_PATCHES:
            haste = Haste(self._lanes.turns, _PATIENCE_S, eager=True)
        spread = Spread(
            patches,
            max(1, size),
            submit=submit,
            wait=self._wait,
            drop=self.drop,
            on_done=on_done,
        )
        return await spread.run(2 * workers, self._priority(patches), haste)

    async def _wait(self, handle: Any) -> None:
        try:
            await self._pool.wait(handle)
        finally:
            self._over(handle)

    def _over(self, handle: Any) -> None:
        if handle in self._places:
            self._lanes.load[self._places.pop(handle)] -= 1

    async def _ask(
        self,
        stage: Stage,
        args: tuple[Any, ...],
        describe: Stage,
        asking: tuple[Any, ...],
        priority: float,
        *,
        long: bool = False,
        place: str | None = None,
    ) -> tuple[Any, Any]:
        handle = self.submit(stage, *args, priority=priority, long=long, place=place)
        # Queued right away: a question asked later would cost another round trip.
        described = self.submit(describe, handle, *asking)
        try:
            value = await self._pool.fetch(described)
        except asyncio.CancelledError:
            self.drop([handle])
            raise
        finally:
            self.drop([described])
        return handle, value

    def _priority(self, patches: int) -> float:
        return Lanes.priority(self._came, patches, background=self._order.background)
