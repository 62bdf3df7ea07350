# SPDX-License-Identifier: Apache-2.0
"""The engine: a backend of workers with an event loop of its own.

Dask's scheduler works in an event loop. It gets one in its own thread, so that however busy it
is, the loop that answers requests and probes is not.
"""

import asyncio
import signal
import subprocess
import threading
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import structlog

from pugeo_model.kernel_cache import compile_kernels
from pugeo_model.weights import Weights
from pugeo_service.engine.backend import Backend
from pugeo_service.engine.dask_backend import DaskBackend
from pugeo_service.engine.errors import EngineLostError, EngineStartError, WorkerLostError
from pugeo_service.engine.messages import (
    BodyReader,
    InMemory,
    ModelId,
    ProgressCallbacks,
    RunRequest,
    RunResult,
)
from pugeo_service.engine.orchestrator import Orchestrator
from pugeo_service.engine.scheduling import SchedulingPolicy
from pugeo_service.engine.self_test import self_test_body, self_test_request
from pugeo_service.observability.telemetry import WorkerUse
from pugeo_service.settings import Settings

__all__ = ["Engine", "Status"]

T = TypeVar("T")

_log = structlog.stdlib.get_logger("pugeo.engine")


@dataclass(frozen=True)
class Status:
    """The state of the engine, cheap to ask for.

    Attributes:
        workers: warm workers; 0 before the self test succeeded.
        expected: configured number of workers, or ``None`` for an external cluster.
        lost: workers that ended unexpectedly, and not in order.
        retried: patches run again because a worker was lost.
        uses: memory and processor time of each worker.
    """

    workers: int
    expected: int | None
    lost: int
    retried: int
    uses: tuple[WorkerUse, ...] = ()


class Engine:
    """Runs requests. Its public methods are called in the event loop of the front.

    Args:
        settings: decide on the backend and its size.
        model: weights of the self test.
    """

    def __init__(self, settings: Settings, model: ModelId) -> None:
        self._settings = settings
        self._model = model
        self._backend = _make_backend(settings)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        # Suspects run one at a time: the one that ends workers then ends no other task.
        self._quarantine = asyncio.Lock()
        self._policy = SchedulingPolicy(lambda: self._backend.warm_workers)
        self._proven = False
        self._retried = 0
        self._compiling: subprocess.Popen[str] | None = None
        self._stopping = False

    async def start(self) -> None:
        """Start the workers; return once a small request of our own succeeded.

        Raises:
            EngineStartError: kernels cannot be compiled, or our own workers were not ready in time.
        """
        self._loop = asyncio.new_event_loop()
        # Ctrl+C reaches the whole process group, and the front ends its workers in order. They
        # inherit the mask of the thread that starts them; the tracker resets it when it begins.
        resource_tracker.ensure_running()
        self._thread = threading.Thread(
            target=_run_without_interrupts, args=(self._loop,), name="engine", daemon=True
        )
        self._thread.start()
        if self._settings.scheduler is None:
            # Once here, and not once in each worker.
            try:
                await asyncio.to_thread(compile_kernels, _log.info, self._compiles)
            except RuntimeError as error:
                raise EngineStartError(str(error)) from error
        limit = None if self._settings.scheduler else self._settings.start_s
        try:
            async with asyncio.timeout(limit):
                await self._call(self._backend.start())
                await self._call(self._self_test())
        except TimeoutError as error:
            raise EngineStartError(
                f"no worker was ready within {limit:g} s (PUGEO_START_S); each needs about 1 GB of "
                "memory and address space, and its own lines above say what it lacks"
            ) from error
        self._proven = True

    async def stop(self) -> None:
        """End the workers and the thread."""
        self._stopping = True
        if self._compiling is not None:
            self._compiling.kill()
        if self._loop is None or self._thread is None:
            return
        await self._call(self._backend.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        await asyncio.to_thread(self._thread.join)
        self._loop.close()
        self._loop = self._thread = None

    async def install(self, weights: Weights) -> None:
        """Give weights that are not part of the package to all workers; before `start` or later."""
        if self._loop is None:
            await self._backend.install(weights)
        else:
            await self._call(self._backend.install(weights))

    async def remove(self, sha256: str) -> None:
        """Take weights away again; no request may use them any more."""
        await self._call(self._backend.remove(sha256))

    @property
    def status(self) -> Status:
        """The state of the workers, at most half a second old."""
        expected = self._settings.worker_count if self._settings.scheduler is None else None
        warm = self._backend.warm_workers if self._proven else 0
        retried = self._backend.retried_patches + self._retried
        return Status(warm, expected, self._backend.lost_workers, retried, self._backend.uses)

    async def run(
        self,
        body: BodyReader,
        request: RunRequest,
        *,
        on_patches: Callable[[int], object],
        on_done: Callable[[int], object],
        on_stage: Callable[[str], object] = lambda _: None,
    ) -> RunResult:
        """Run a request to its end; cancelling this cancels its tasks.

        Args:
            body: the request's bytes; they are read when the engine begins.
            request: to run.
            on_patches: called with the number of patches, in the caller's event loop.
            on_done: called with the number of further patches done, in the caller's event loop.
            on_stage: called with the name of a stage that begins, in the caller's event loop.

        Raises:
            CloudError: the input cannot be used.
            WorkerLostError: it ended worker processes, even when run alone.
            EngineLostError: the scheduler is gone.
            DiskError: the body cannot be read, or there is no room for the answer.
        """
        here = asyncio.get_running_loop()
        progress = ProgressCallbacks(
            lambda count: here.call_soon_threadsafe(on_patches, count),
            lambda count: here.call_soon_threadsafe(on_done, count),
            lambda stage: here.call_soon_threadsafe(on_stage, stage),
        )
        return await self._call(self._run(body, request, progress))

    def _compiles(self, process: "subprocess.Popen[str]") -> None:
        """Keep the process that compiles kernels, in whose thread this is called."""
        self._compiling = process
        if self._stopping:
            process.kill()

    async def _self_test(self) -> None:
        request = self_test_request(self._model, self._settings.deadline_s)
        run = self._orchestrator(request, ProgressCallbacks())
        (await run.run(InMemory(self_test_body()))).spool.close()

    async def _run(
        self, body: BodyReader, request: RunRequest, progress: ProgressCallbacks
    ) -> RunResult:
        done = 0

        def on_done(count: int) -> None:
            nonlocal done
            done += count
            progress.on_done(count)

        counting = replace(progress, on_done=on_done)
        try:
            return await self._orchestrator(request, counting).run(body)
        except (WorkerLostError, EngineLostError):
            # It may be innocent: Dask blames every task that was queued on a dead worker.
            self._retried += done
            async with self._quarantine:
                return await self._orchestrator(request, counting).run(body)

    def _orchestrator(self, request: RunRequest, progress: ProgressCallbacks) -> Orchestrator:
        spool_dir = self._settings.spool_dir
        return Orchestrator(self._backend, request, self._policy, progress, spool_dir)

    async def _call(self, work: Coroutine[Any, Any, T]) -> T:
        if self._loop is None:
            work.close()
            raise EngineLostError("the engine is not running")
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self._loop))


def _run_without_interrupts(loop: asyncio.AbstractEventLoop) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    loop.run_forever()


def _make_backend(settings: Settings) -> Backend:
    if settings.engine == "inline":
        # Imported here, since it loads the model and torch into this process.
        from pugeo_service.engine.inline_backend import InlineBackend

        return InlineBackend(settings)
    return DaskBackend(settings)
