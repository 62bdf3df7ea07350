# SPDX-License-Identifier: Apache-2.0
"""Dispatch of the tasks of one request: priority, turns, and the worker that runs each.

Left alone, Dask runs a task on the worker that holds its inputs, so that all of a request would
stay on one worker. Parts of a stage are therefore placed on workers here.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Any, TypeVar

from pugeo_service.engine import stages
from pugeo_service.engine.backend import Backend, Handle
from pugeo_service.engine.bounded_map import BoundedMap, StarvationGuard
from pugeo_service.engine.messages import RunRequest
from pugeo_service.engine.scheduling import LARGE_PATCHES, SchedulingPolicy
from pugeo_service.engine.values import PredictedBatch, Prepared

__all__ = ["Dispatch", "WorkerOf"]

T = TypeVar("T")
D = TypeVar("D")

WorkerOf = Callable[[], str | None]
"""Returns the worker that holds a tile, where no other worker should run its tasks."""

# Seconds without progress after which a cloud that others overtake takes a turn.
_PATIENCE_S = 2.0
_BACKGROUND_PATIENCE_S = 5.0
# Patches of one task: one where they are carried to other workers; where they stay, three take
# 0.2 s, which is what a small cloud may have to wait.
_CARRIED_PATCHES = 1
_PATCHES_IN_PLACE = 3


class Dispatch:
    """The tasks of a request.

    Args:
        backend: runs them.
        request: to run.
        policy: decides on the order among all requests of the engine.
    """

    def __init__(self, backend: Backend, request: RunRequest, policy: SchedulingPolicy) -> None:
        self._backend = backend
        self._request = request
        self._policy = policy
        self._arrived = time.monotonic()
        self._ends = self._arrived + request.deadline_s
        self._handles: set[Handle[Any]] = set()
        self._placed: dict[Handle[Any], str] = {}

    def submit(
        self,
        stage: Callable[..., T],
        *args: Any,
        priority: float = SchedulingPolicy.FIRST,
        long: bool = False,
        patches: int = 0,
        worker: str | None = None,
    ) -> Handle[T]:
        """Queue a task; see ``Backend.submit``."""
        left = self._ends - time.monotonic()
        handle = self._backend.submit(
            stage, *args, priority=priority, seconds=left, long=long, patches=patches, worker=worker
        )
        self._handles.add(handle)
        return handle

    async def fetch(self, handle: Handle[T]) -> T:
        """Wait for a result and bring it here."""
        return await self._backend.fetch(handle)

    def drop(self, *handles: Handle[Any]) -> None:
        """Drop results; tasks already submitted still get them."""
        self._backend.release(handles)
        self._handles.difference_update(handles)

    def cancel(self) -> None:
        """Drop all results, and all tasks that have not begun."""
        self._backend.cancel(self._handles)
        # Some parts may have nobody who waits for them yet.
        for handle in list(self._placed):
            self._unplace(handle)

    @property
    def every_worker_is_busy(self) -> bool:
        """Whether each worker has a request, so that spreading one over all gains nothing."""
        return len(self._policy.requests) >= self._backend.warm_workers

    async def step(
        self,
        patches: int,
        stage: Callable[..., T],
        args: tuple[Any, ...],
        describe: Callable[..., D],
        describe_args: tuple[Any, ...] = (),
        *,
        worker: str | None = None,
    ) -> tuple[Handle[T], D]:
        """Run a stage as one task, and bring its description.

        Args:
            patches: of the cloud, which decide on its priority.
            stage: function of the stages.
            args: of the stage.
            describe: quick stage that describes the result.
            describe_args: arguments of ``describe`` after the result.
            worker: to run it; where most of ``args`` are if ``None``.

        Returns:
            The handle of the result, and the description.
        """

        async def run(priority: float, *, long: bool = False) -> tuple[Handle[T], D]:
            handle = self.submit(stage, *args, priority=priority, long=long, worker=worker)
            # Queued right away: a question asked later would cost another round trip.
            described = self.submit(describe, handle, *describe_args)
            try:
                return handle, await self._backend.fetch(described)
            except asyncio.CancelledError:
                self.drop(handle)
                raise
            finally:
                self.drop(described)

        if patches >= LARGE_PATCHES:
            async with self._policy.turns:
                return await run(SchedulingPolicy.FIRST, long=True)
        if not self._request.background:
            return await run(self._priority(patches))
        try:
            async with asyncio.timeout(_BACKGROUND_PATIENCE_S):
                return await run(self._priority(patches))
        except TimeoutError:
            # A stage of a small cloud takes about a second once it runs, so it hardly ran.
            return await run(SchedulingPolicy.FIRST)

    async def predict(
        self,
        tile: Handle[Prepared],
        patches: int,
        worker_of: WorkerOf,
        on_done: Callable[[int], object],
    ) -> list[Handle[PredictedBatch]]:
        """Run the patches of a tile through the network, in parts.

        Args:
            tile: handle of the prepared tile.
            patches: of the tile.
            worker_of: asked for each part: the worker that holds the tile, if all is to stay there.
            on_done: called with the number of further patches that are done.

        Returns:
            The handles of the parts' results, in order.
        """
        model = self._request.model

        def carried() -> bool:
            return worker_of() is None and not self.every_worker_is_busy

        def submit(start: int, stop: int, priority: float) -> Handle[PredictedBatch]:
            worker, count = worker_of(), stop - start
            if carried():
                worker = self._policy.least_loaded(self._backend.worker_names)
                part = self.submit(stages.take_patches, tile, start, stop, priority=priority)
                result = self.submit(
                    stages.predict, part, model, priority=priority, patches=count, worker=worker
                )
                self.drop(part)
            else:
                result = self.submit(
                    stages.predict_in_place,
                    tile,
                    start,
                    stop,
                    model,
                    priority=priority,
                    patches=count,
                    worker=worker,
                )
            if worker is not None:
                self._policy.load[worker] += 1
                self._placed[result] = worker
            return result

        guard = None
        if self._request.background:
            guard = StarvationGuard(self._policy.turns, _BACKGROUND_PATIENCE_S, eager=False)
        elif patches >= LARGE_PATCHES:
            guard = StarvationGuard(self._policy.turns, _PATIENCE_S, eager=True)
        parts = BoundedMap(
            patches,
            _CARRIED_PATCHES if carried() else _PATCHES_IN_PLACE,
            submit=submit,
            wait=self._wait,
            drop=lambda handles: self.drop(*handles),
            on_done=on_done,
        )
        window = 2 * max(1, self._backend.warm_workers)
        return await parts.run(window, self._priority(patches), guard)

    async def _wait(self, handle: Handle[Any]) -> None:
        try:
            await self._backend.wait(handle)
        finally:
            self._unplace(handle)

    def _unplace(self, handle: Handle[Any]) -> None:
        if handle in self._placed:
            self._policy.load[self._placed.pop(handle)] -= 1

    def _priority(self, patches: int) -> float:
        return SchedulingPolicy.priority(
            self._arrived, patches, background=self._request.background
        )
