# SPDX-License-Identifier: Apache-2.0
"""Threads of this process in the place of workers, for a debugger. Not for serving."""

import asyncio
from collections.abc import Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any

from pugeo_service.engine import stages
from pugeo_service.engine.backend import Stage
from pugeo_service.engine.errors import EngineLostError
from pugeo_service.engine.worker import warm
from pugeo_service.settings import Settings

__all__ = ["InlinePool"]


class InlinePool:
    """The ``Pool`` of ``PUGEO_ENGINE=inline``.

    A task waits in its thread for the tasks that it depends on. They were submitted earlier and
    the executor starts tasks in order, so there is always one that can go on.
    """

    lost_workers = 0
    retried_patches = 0

    def __init__(self, settings: Settings) -> None:
        self._model = settings.model
        self._threads = settings.worker_count
        self._executor = ThreadPoolExecutor(self._threads, "pugeo-inline")
        self._warm = False

    @property
    def warm_workers(self) -> int:
        """Threads, once the model is loaded."""
        return self._threads if self._warm else 0

    @property
    def places(self) -> tuple[str, ...]:
        """Threads have names, but share all that they hold."""
        return tuple(str(number) for number in range(self.warm_workers))

    async def start(self) -> None:
        """Load and warm the model in this process."""
        await asyncio.get_running_loop().run_in_executor(self._executor, warm, self._model)
        self._warm = True

    async def stop(self) -> None:
        """Let running tasks end and drop the others."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def submit(
        self,
        stage: Stage,
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        place: str | None = None,
    ) -> "Future[Any]":
        """Queue ``stage(*args)``, first come first served."""
        del priority, seconds, long, patches, place  # threads cannot be ranked, ended, lost
        run = getattr(stages, stage)
        return self._executor.submit(lambda: run(*(_resolved(arg) for arg in args)))

    async def wait(self, handle: "Future[Any]") -> None:
        """Wait for a result."""
        await self.fetch(handle)

    async def fetch(self, handle: "Future[Any]") -> Any:
        """Wait for a result and return it."""
        try:
            return await asyncio.shield(asyncio.wrap_future(handle))
        except CancelledError as error:
            if handle.cancelled():
                raise EngineLostError("the task was cancelled") from error
            raise

    def release(self, handles: Iterable["Future[Any]"]) -> None:
        """Do nothing: results live as long as somebody refers to them."""

    def cancel(self, handles: Iterable["Future[Any]"]) -> None:
        """Drop whatever has not begun yet."""
        for handle in handles:
            handle.cancel()


def _resolved(arg: Any) -> Any:
    if isinstance(arg, Future):
        return arg.result()
    if isinstance(arg, list):
        return [_resolved(item) for item in arg]
    return arg
