# SPDX-License-Identifier: Apache-2.0
"""Threads of this process instead of workers, for a debugger; not for production."""

import asyncio
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any, TypeVar, cast

from pugeo_model.weights import Weights
from pugeo_service.engine import model_store
from pugeo_service.engine.backend import Handle
from pugeo_service.engine.errors import EngineLostError
from pugeo_service.engine.worker import warm
from pugeo_service.observability.telemetry import WorkerUse
from pugeo_service.settings import Settings

__all__ = ["InlineBackend"]

T = TypeVar("T")


class InlineBackend:
    """The `Backend` of ``PUGEO_ENGINE=inline``.

    A task waits in its thread for the tasks that it depends on. They were submitted earlier and
    the executor starts tasks in order, so there is always one that can go on.
    """

    lost_workers = 0
    worker_memory: int | None = None
    retried_patches = 0
    uses: tuple[WorkerUse, ...] = ()

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
    def worker_names(self) -> tuple[str, ...]:
        """Numbers of the threads, which share all results."""
        return tuple(str(number) for number in range(self.warm_workers))

    async def start(self) -> None:
        """Load and warm the model in this process."""
        await asyncio.get_running_loop().run_in_executor(self._executor, warm, self._model)
        self._warm = True

    async def stop(self) -> None:
        """Let running tasks end and drop the others."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    async def install(self, weights: Weights) -> None:
        """Keep weights in this process."""
        model_store.install(weights)

    async def remove(self, sha256: str) -> None:
        """Forget weights."""
        model_store.remove(sha256)

    def submit(
        self,
        stage: Callable[..., T],
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        worker: str | None = None,
    ) -> Handle[T]:
        """Queue ``stage(*args)``, first come first served."""
        del priority, seconds, long, patches, worker  # threads cannot be ranked, ended or lost
        handle: Any = self._executor.submit(lambda: stage(*(_resolved(arg) for arg in args)))
        return cast("Handle[T]", handle)

    async def wait(self, handle: Handle[Any]) -> None:
        """Wait for a result."""
        await self.fetch(handle)

    async def fetch(self, handle: Handle[T]) -> T:
        """Wait for a result and return it."""
        future = _future(handle)
        try:
            result: T = await asyncio.shield(asyncio.wrap_future(future))
        except CancelledError as error:
            if future.cancelled():
                raise EngineLostError("the task was cancelled") from error
            raise
        return result

    def release(self, handles: Iterable[Handle[Any]]) -> None:
        """Do nothing: results live as long as something refers to them."""

    def cancel(self, handles: Iterable[Handle[Any]]) -> None:
        """Drop tasks that have not begun."""
        for handle in handles:
            _future(handle).cancel()


def _future(handle: Handle[Any]) -> "Future[Any]":
    return cast("Future[Any]", handle)


def _resolved(arg: Any) -> Any:
    if isinstance(arg, Future):
        return arg.result()
    if isinstance(arg, list):
        return [_resolved(item) for item in arg]
    return arg
