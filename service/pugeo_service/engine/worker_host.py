# SPDX-License-Identifier: Apache-2.0
"""The workers of one machine, which join a scheduler of another one."""

import asyncio
import contextlib
import logging
import subprocess
from typing import Any

import distributed
import structlog

from pugeo_model.kernel_cache import compile_kernels
from pugeo_service.engine.children import end_children
from pugeo_service.engine.dask_config import configure_dask, mutual_tls, worker_environment
from pugeo_service.engine.heartbeats import cpu_seconds
from pugeo_service.engine.worker_watch import CPU_SECONDS
from pugeo_service.settings import Settings

__all__ = ["WorkerHost"]

_log = structlog.stdlib.get_logger("pugeo.worker")
# Dask's annotations cover half of it and contradict the other half.
_dask: Any = distributed
_RETRY_S = 1.0
_ANSWER_S = 10.0
# Results that only these workers hold move to others, so that they need not be computed again.
_RETIRE_S = 10.0
_CLOSE_S = 10.0
_UNREGISTER_S = 2.0


class _Nanny(distributed.Nanny):
    """Dask's nanny, which waits less for a scheduler that is gone, and tells of its worker."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.handlers[CPU_SECONDS] = self._cpu_seconds

    def _cpu_seconds(self) -> float | None:
        """Return the processor time of the worker; ``None`` if there is none."""
        return cpu_seconds(self.pid) if self.pid else None

    async def _unregister(self, timeout: float = _UNREGISTER_S) -> None:  # noqa: ASYNC109
        """Tell the scheduler that the worker process has ended; it sees that itself as well."""
        shorter = min(timeout, _UNREGISTER_S)
        await super()._unregister(shorter)  # type: ignore[no-untyped-call]


class WorkerHost:
    """Keeps worker processes at a scheduler, which may go away and come back.

    Args:
        settings: the scheduler, certificates, number and memory of workers, weights, spool folder.
        host: address at which other machines reach these workers; ``None``: the one from which
            this machine reaches the scheduler.
        port: first of two ports for each worker; ``None``: free ones.
    """

    def __init__(
        self, settings: Settings, host: str | None = None, port: int | None = None
    ) -> None:
        self._settings = settings
        self._host, self._port = host, port
        self._security = mutual_tls(settings)
        self._connection = self._security.get_connection_args("worker")
        self._nannies: set[Any] = set()
        self._reaching = asyncio.Lock()
        self._reached = asyncio.Event()
        self._ready = asyncio.Event()

    async def run(self, stop: asyncio.Event) -> int:
        """Keep workers until ``stop`` is set.

        Returns:
            The exit status: 0, or 1 if kernels cannot be compiled, or if no worker was ready
            within the time for it although the scheduler answers.
        """
        stopping = asyncio.create_task(stop.wait())
        try:
            if not await self._compile(stopping):
                return 0
        except RuntimeError as error:
            _log.error("workers cannot start", reason=str(error))
            return 1
        configure_dask()
        keeping = [
            asyncio.create_task(self._keep(number)) for number in range(self._settings.worker_count)
        ]
        failing = asyncio.create_task(self._until_too_late())
        try:
            await asyncio.wait({stopping, failing}, return_when=asyncio.FIRST_COMPLETED)
            status = 0 if stopping.done() else 1
            await self._retire()
        finally:
            for task in (*keeping, failing, stopping):
                task.cancel()
            await asyncio.gather(*keeping, failing, stopping, return_exceptions=True)
            end_children()
        return status

    async def _compile(self, stopping: "asyncio.Task[Any]") -> bool:
        """Compile kernels once for all workers; return False if it was stopped.

        Raises:
            RuntimeError: they cannot be compiled.
        """
        started: list[subprocess.Popen[str]] = []
        compiling = asyncio.create_task(
            asyncio.to_thread(compile_kernels, _log.info, started.append)
        )
        await asyncio.wait({compiling, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if not stopping.done():
            await compiling
            return True
        for process in started:
            process.kill()
        await asyncio.gather(compiling, return_exceptions=True)
        return False

    async def _until_too_late(self) -> None:
        """Return if the scheduler answers and no worker becomes ready in time."""
        await self._reached.wait()
        try:
            async with asyncio.timeout(self._settings.start_s):
                await self._ready.wait()
        except TimeoutError:
            _log.error(
                "no worker was ready in time (PUGEO_START_S); each needs about 1 GB of memory",
                seconds=self._settings.start_s,
            )
        else:
            await asyncio.Event().wait()

    async def _keep(self, number: int) -> None:
        """Keep one worker process, until cancelled."""
        port = None if self._port is None else self._port + 2 * number
        settings = self._settings
        while True:
            await self._reach_scheduler()
            nanny: Any = _Nanny(
                settings.scheduler,
                nthreads=1,
                memory_limit=settings.worker_memory,
                security=self._security,
                host=self._host,
                worker_port=port,
                port=None if port is None else port + 1,
                local_directory=str(settings.spool_dir),
                dashboard=False,
                dashboard_address="127.0.0.1:0",
                death_timeout=settings.start_s,
                silence_logs=logging.WARNING,
                env=worker_environment(settings.model),
            )
            self._nannies.add(nanny)
            try:
                await nanny
                self._ready.set()
                _log.info("a worker is ready", address=nanny.worker_address)
                await nanny.finished()
                _log.warning("a worker has lost the scheduler; it starts again")
            except Exception as error:  # noqa: BLE001 - whatever it is, the next attempt may succeed
                _log.error("a worker did not start; it is tried again", reason=_reason(error))
            finally:
                self._nannies.discard(nanny)
                with contextlib.suppress(Exception):
                    await asyncio.wait_for(nanny.close(timeout=_CLOSE_S / 2), _CLOSE_S)
            await asyncio.sleep(_RETRY_S)

    async def _reach_scheduler(self) -> None:
        """Return once the scheduler answers; log each new reason for which it does not."""
        address, told = self._settings.scheduler, ""
        async with self._reaching:
            while True:
                try:
                    answer = await _dask.comm.connect(
                        address, timeout=_ANSWER_S, **self._connection
                    )
                except Exception as error:  # noqa: BLE001 - also TLS errors of all kinds
                    reason = _reason(error)
                    if reason != told:
                        _log.warning(
                            "the scheduler does not answer; it is tried again",
                            scheduler=address,
                            reason=reason,
                        )
                    told = reason
                    await asyncio.sleep(_RETRY_S)
                else:
                    answer.abort()
                    self._reached.set()
                    return

    async def _retire(self) -> None:
        """Let other workers take over the results of these, and sign these off."""
        workers = [nanny.worker_address for nanny in self._nannies if nanny.worker_address]
        if not workers:
            return
        async with _dask.rpc(
            self._settings.scheduler, connection_args=self._connection
        ) as scheduler:
            try:
                async with asyncio.timeout(_RETIRE_S):
                    await scheduler.retire_workers(
                        workers=workers, close_workers=False, remove=True
                    )
            except Exception as error:  # noqa: BLE001 - the results are computed again then
                _log.warning("results are not handed over", reason=_reason(error))
            # Where nobody could take them over, the scheduler still has the worker; it would count
            # as lost, and its tasks as suspicious.
            with contextlib.suppress(Exception):
                async with asyncio.timeout(_UNREGISTER_S):
                    for address in workers:
                        await scheduler.unregister(
                            address=address, stimulus_id="pugeo-worker-leaves", expected=True
                        )


def _reason(error: BaseException) -> str:
    """Return the text of an error and of its causes in one line."""
    texts: list[str] = []
    cause: BaseException | None = error
    while cause is not None:
        text = " ".join(str(cause).split()) or type(cause).__name__
        if not any(text in earlier for earlier in texts):
            texts.append(text)
        cause = cause.__cause__ or cause.__context__
    return ": ".join(texts)[:300]
