# SPDX-License-Identifier: Apache-2.0
"""Backend of Dask worker processes: local ones, or an external cluster.

It uses private names of distributed: pyproject.toml bounds the version, and
tests/service/test_private_names.py checks that each name exists.
"""

import asyncio
import contextlib
import logging
import os
import secrets
import signal
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import distributed
import psutil
import structlog
from distributed.client import ClosedClientError, FutureCancelledError
from distributed.scheduler import KilledWorker

from pugeo_model.weights import Weights
from pugeo_service.engine.backend import CORE, QUICK, Handle, is_quick
from pugeo_service.engine.children import end_processes
from pugeo_service.engine.dask_config import (
    configure_dask,
    mutual_tls,
    scheduler_options,
    worker_environment,
)
from pugeo_service.engine.errors import EngineLostError, EngineStartError, WorkerLostError
from pugeo_service.engine.heartbeats import HeartbeatWatch, cpu_seconds
from pugeo_service.engine.membership import EVENTS, Membership
from pugeo_service.engine.model_plugin import ModelPlugin
from pugeo_service.engine.retries import TOPIC, ReportRetries
from pugeo_service.engine.worker import run_stage
from pugeo_service.observability.telemetry import WorkerUse
from pugeo_service.settings import Settings

__all__ = ["DaskBackend"]

T = TypeVar("T")

_log = structlog.stdlib.get_logger("pugeo.engine")
# Its annotations cover half of it and contradict the other half.
_dask: Any = distributed

_GONE = frozenset({distributed.Status.closed, distributed.Status.failed})
_POLL_S = 0.5
# Without an answer of the scheduler for so long, no worker counts. The embedded one answers in this
# event loop, which may be busy; one that is cut off must be told of within 2 s.
_SILENCE_S = 3.0
_FAR_SILENCE_S = 1.0
# So long until the connection is given up, and all that runs with it.
_LOST_S = 10.0
_CLUSTER_START_S = 2.0
_CLOSE_S = 20.0


class DaskBackend:
    """The `Backend` of the service."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._cluster: Any = None
        self._starting_cluster: asyncio.Future[Any] | None = None
        self._client: Any = None
        self._poll: asyncio.Task[None] | None = None
        self._members = Membership()
        self._heartbeats = HeartbeatWatch()
        # Processes that are not workers yet, and the times at which they were first seen.
        self._starting: dict[int, float] = {}
        self.retried_patches = 0
        # Weights that workers do not have by themselves.
        self._weights: dict[str, Weights] = {}
        # Distinguishes the tasks of this front from those of others at the same scheduler.
        self._name = secrets.token_hex(6)

    @property
    def warm_workers(self) -> int:
        """Workers known to the scheduler; their preload warmed them before it knew them.

        None without a connection to the scheduler, whose loss the client sees at once.
        """
        return len(self._members.names) if getattr(self._client, "status", "") == "running" else 0

    @property
    def worker_names(self) -> tuple[str, ...]:
        """Names or addresses of the workers."""
        return tuple(sorted(self._members.names))

    @property
    def worker_memory(self) -> int | None:
        """Bytes that each worker may use; ``None`` if they are unlimited or unknown."""
        return self._members.memory

    @property
    def lost_workers(self) -> int:
        """Workers that ended unexpectedly since the start."""
        return self._members.lost

    @property
    def uses(self) -> tuple[WorkerUse, ...]:
        """Memory and processor time of each worker, some seconds old."""
        return self._members.uses

    async def start(self) -> None:
        """Start the cluster or reach it; returns once a worker is warm.

        Raises:
            EngineStartError: no worker process can start.
        """
        configure_dask()
        settings = self._settings
        if settings.scheduler is None:
            security = _dask.Security.temporary()
            self._cluster = _dask.LocalCluster(
                n_workers=settings.worker_count,
                processes=True,
                threads_per_worker=1,
                memory_limit=settings.worker_memory,
                asynchronous=True,
                security=security,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs=scheduler_options(),
                local_directory=str(settings.spool_dir),
                env=worker_environment(settings.model),
            )
            # Cancelling the start does not cancel this: a cluster can be closed when it is up, or
            # before it began, but not in between.
            self._starting_cluster = asyncio.ensure_future(self._cluster)
            try:
                await asyncio.shield(self._starting_cluster)
            except RuntimeError as error:
                raise EngineStartError(
                    "the worker processes end while they start; their own lines above say why, and "
                    "each needs about 1 GB of memory and address space"
                ) from error
        await self._connect()
        while not (await self._connected.scheduler.identity(n_workers=-1))["workers"]:
            with contextlib.suppress(TimeoutError):
                await self._connected.wait_for_workers(1, timeout=settings.start_s)
                break
            _log.warning("no worker has joined the scheduler", seconds=settings.start_s)
        await self._refresh_workers()
        self._poll = asyncio.create_task(self._poll_workers())

    async def stop(self) -> None:
        """Close the connection, and the workers if they are ours."""
        if self._poll is not None:
            self._poll.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._poll
        # Read before the nannies close, which forget processes that do not end in time.
        processes = self._processes()
        try:
            if self._client is not None:
                await asyncio.wait_for(self._client.close(), _CLOSE_S)
            if self._starting_cluster is not None:
                await asyncio.wait({self._starting_cluster}, timeout=_CLUSTER_START_S)
                if not self._starting_cluster.done():
                    # A worker takes long to start, or hangs; its nanny reports the end as a fault.
                    asyncio.get_running_loop().set_exception_handler(lambda _, __: None)
                    logging.getLogger("distributed").setLevel(logging.CRITICAL)
                    logging.getLogger("distributed.nanny").setLevel(logging.CRITICAL)
                    end_processes(self._processes())
                    await asyncio.wait({self._starting_cluster}, timeout=_CLOSE_S)
            if self._cluster is not None:
                await asyncio.wait_for(self._cluster.close(), _CLOSE_S)
        except Exception as error:  # noqa: BLE001 - whatever fails here, the processes must end
            _log.warning("workers did not stop in order", reason=str(error) or type(error).__name__)
        finally:
            end_processes(processes | self._processes())

    async def install(self, weights: Weights) -> None:
        """Give weights to all workers, also to those that come later."""
        self._weights[weights.card["sha256"]] = weights
        if self._client is not None:
            with contextlib.suppress(OSError):  # `_connect` gives them to the next scheduler
                await self._client.register_plugin(ModelPlugin(weights, self._name))

    async def remove(self, sha256: str) -> None:
        """Take weights away from all workers."""
        if self._weights.pop(sha256, None) is not None and self._client is not None:
            name = ModelPlugin.name_of(sha256, self._name)
            with contextlib.suppress(ValueError, OSError):  # a new scheduler does not know it
                await self._client.unregister_worker_plugin(name)

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
        """Queue ``stage(*args)``."""
        # Dask guesses how long a task takes from others whose key begins alike.
        prefix = f"{stage.__name__}_{'long' if long else 'short'}"
        key = f"{prefix}-{patches}-{self._name}-{secrets.token_hex(12)}"
        try:
            handle: Handle[T] = self._connected.submit(
                run_stage,
                stage,
                seconds,
                *args,
                key=key,
                pure=False,
                priority=priority,
                workers=worker,
                # The named worker may be gone.
                allow_other_workers=worker is not None,
                resources=self._resources(stage),
            )
        except ClosedClientError as error:
            raise EngineLostError(str(error)) from error
        return handle

    def _resources(self, stage: Callable[..., Any]) -> dict[str, int] | None:
        if not is_quick(stage):
            return {CORE: 1}
        # Our own workers are all of this version, and Dask's own scheduler lets tasks with a
        # resource wait behind those that wait for the core.
        return {QUICK: 1} if self._cluster is None else None

    async def wait(self, handle: Any) -> None:
        """Wait for a result without moving it."""
        error = await handle.exception()
        if error is not None:
            raise _translated(error)
        if handle.cancelled():
            raise EngineLostError(f"the scheduler forgot {handle.key}")

    async def fetch(self, handle: Any) -> Any:
        """Wait for a result and bring it here."""
        await self.wait(handle)
        try:
            return await self._connected.gather(handle)
        except (KilledWorker, FutureCancelledError) as error:
            raise _translated(error) from error

    def release(self, handles: Iterable[Any]) -> None:
        """Drop results; tasks already submitted still get them."""
        for handle in handles:
            handle.release()

    def cancel(self, handles: Iterable[Any]) -> None:
        """Drop results; Dask drops tasks that have not begun once nothing refers to them."""
        self.release(handles)

    async def _connect(self) -> None:
        settings = self._settings
        if self._cluster is not None:
            address, security = self._cluster, self._cluster.security
        else:
            address, security = settings.scheduler, mutual_tls(settings)
        # Results go from worker to front without a copy in the scheduler.
        self._client = await _dask.Client(
            address, asynchronous=True, security=security, direct_to_workers=True, timeout="30s"
        )
        self._client.subscribe_topic(EVENTS, self._members.on_event)
        try:
            await self._client.register_plugin(ReportRetries())
        except Exception as error:  # noqa: BLE001 - a count is not worth a connection
            _log.warning("retries are not counted", reason=str(error))
        else:
            self._client.subscribe_topic(TOPIC, self._count_retry)
        for weights in list(self._weights.values()):
            await self._client.register_plugin(ModelPlugin(weights, self._name))

    def _count_retry(self, event: tuple[float, str]) -> None:
        _, patches, front, _ = event[1].split("-")
        if front == self._name:
            self.retried_patches += int(patches)

    @property
    def _connected(self) -> Any:
        if self._client is None:
            raise EngineLostError("the engine has not started")
        return self._client

    async def _poll_workers(self) -> None:
        silence = _SILENCE_S if self._cluster is not None else _FAR_SILENCE_S
        while True:
            await asyncio.sleep(_POLL_S)
            looking = asyncio.create_task(self._refresh_workers())
            try:
                async with asyncio.timeout(_LOST_S):
                    await asyncio.wait({looking}, timeout=silence)
                    if not looking.done():
                        self._members.names = frozenset()
                    await looking
            except (OSError, EngineLostError) as error:
                self._members.forget()
                if self._cluster is None:
                    _log.warning("the scheduler is lost; it is tried again", reason=str(error))
                    await self._connect_again()
            finally:
                looking.cancel()

    async def _connect_again(self) -> None:
        """Connect again to a scheduler that went away; Dask's own client gives up too early."""
        client, self._client = self._client, None
        with contextlib.suppress(OSError):
            if client is not None:
                await client.close(timeout=1)
            await self._connect()
            _log.info("connected to the scheduler again")

    async def _refresh_workers(self) -> None:
        scheduler = self._connected.scheduler
        if scheduler is None:
            raise EngineLostError("the connection to the scheduler is closed")
        identity = await scheduler.identity(n_workers=-1)
        hanging = self._heartbeats.hanging(
            {address: worker["last_seen"] for address, worker in identity["workers"].items()},
            {address: cpu_seconds(pid) for address, pid in self._pids().items()},
        )
        self._members.see(identity["workers"], hanging)
        if self._cluster is not None:
            self._end_hanging(hanging)
            self._replace_nannies()

    def _processes(self) -> set[psutil.Process]:
        """Return our own worker processes, also those that are starting."""
        found: set[psutil.Process] = set()
        # `workers` holds only the ones that have reported to the scheduler.
        created = [] if self._cluster is None else self._cluster._created  # noqa: SLF001
        for nanny in list(created):
            process = nanny.process and nanny.process.process
            with contextlib.suppress(psutil.Error):
                if process is not None and process.pid is not None:
                    found.add(psutil.Process(process.pid))
        return found

    def _pids(self) -> dict[str, int]:
        """Return the process ids of our own workers by their addresses."""
        nannies = [] if self._cluster is None else self._cluster.workers.values()
        return {nanny.worker_address: nanny.pid for nanny in nannies if nanny.pid}

    def _end_hanging(self, hanging: frozenset[str]) -> None:
        """End workers that hang; their nannies start others, and Dask repeats their tasks."""
        for address, pid in self._pids().items():
            if address in hanging:
                _log.error("a worker gives no sign; it is ended and replaced", pid=pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        now = time.monotonic()
        starting = {
            nanny.process.process.pid
            for nanny in self._cluster.workers.values()
            if nanny.process is not None
            and nanny.process.process is not None
            and nanny.worker_address is None
        }
        self._starting = {pid: self._starting.get(pid, now) for pid in starting if pid}
        for pid, since in self._starting.items():
            if now - since > self._settings.start_s:
                _log.error("a worker does not start; it is ended and replaced", pid=pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    def _replace_nannies(self) -> None:
        """Replace nanny processes that gave up, for example because of too little memory."""
        nannies = self._cluster.workers
        gone = [name for name, nanny in nannies.items() if nanny.status in _GONE]
        for name in gone:
            del nannies[name]
        if gone:
            self._cluster.scale(self._settings.worker_count)


def _translated(error: BaseException) -> BaseException:
    if isinstance(error, KilledWorker):
        return WorkerLostError(str(error))
    if isinstance(error, FutureCancelledError):
        return EngineLostError(str(error))
    return error
