# SPDX-License-Identifier: Apache-2.0
"""Periodic maintenance of jobs: takeover, expiry, removal of unused files."""

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog

from pugeo_service.jobs import clock, repository
from pugeo_service.jobs.completion import Completion, crash_problem
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.process_lock import ProcessLock
from pugeo_service.jobs.repository import JobUsage
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.storage.reserve import Reserve

__all__ = ["Maintenance"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_INTERVAL_S = 2.0
_SWEEP_S = 600.0
# Files of jobs that are not in the table yet are younger than this.
_ORPHAN_S = 3600.0
# Time that a job and its idempotency key are kept after its result has expired.
_KEEP_ROW_S = 7 * 86400.0


class Maintenance:
    """Takes over jobs of ended processes, expires results, removes unused files.

    Args:
        database: database of jobs.
        files: files of jobs.
        lock: finds ended processes.
        completion: ends jobs with too many attempts as failed.
        telemetry: counts expired results.
        requeue_unknown: queues jobs again that the database assigns to this process but that do not
            run.
        reserve: room for the database on a full disk.
        kept_rows: finished jobs without a result that are kept of each owner.
        ended: returns the ended ones among some processes; ``None``: the lock tells.

    Attributes:
        usage: use of the capacity for jobs, at most some seconds old.
    """

    def __init__(
        self,
        database: Database,
        files: JobFiles,
        lock: ProcessLock,
        completion: Completion,
        telemetry: Telemetry,
        requeue_unknown: Callable[[], Awaitable[None]],
        reserve: Reserve,
        kept_rows: int,
        ended: Callable[[list[str]], Awaitable[list[str]]] | None = None,
    ) -> None:
        self._database = database
        self._files = files
        self._lock = lock
        self._completion = completion
        self._telemetry = telemetry
        self._requeue_unknown = requeue_unknown
        self._reserve = reserve
        self._kept_rows = kept_rows
        self._ended = ended or (lambda names: asyncio.to_thread(lock.ended, names))
        self.usage = JobUsage()

    async def start(self) -> None:
        """Take over jobs of ended processes and remove their files, before the first request.

        Raises:
            ProblemError: 503, the database cannot be used.
            OSError: the folder cannot be used.
        """
        await self._take_over()
        # The time is read first: files of a process that starts meanwhile are younger.
        now = clock.now()
        alone = await asyncio.to_thread(lambda: self._lock.is_only_process)
        await self._sweep(now if alone else now - _ORPHAN_S)
        await asyncio.to_thread(self._reserve.fill)
        self.usage = await self._database.read(repository.usage)

    async def run(self) -> None:
        """Repeat maintenance every 2 s until cancelled."""
        swept = time.monotonic()
        while True:
            await asyncio.sleep(_INTERVAL_S)
            try:
                await self._take_over()
                await self._requeue_unknown()
                await self._expire()
                await self._database.free(repository.prune_most, self._kept_rows)
                # Last, when all room that can be given back has been.
                await asyncio.to_thread(self._reserve.fill)
                if time.monotonic() - swept > _SWEEP_S:
                    swept = time.monotonic()
                    await self._database.free(repository.prune, clock.deletion_time() - _KEEP_ROW_S)
                    await self._sweep(clock.deletion_time() - _ORPHAN_S)
                self.usage = await self._database.read(repository.usage)
            except ProblemError:
                continue  # logged by the database
            except OSError as error:
                _log.error("folder of jobs cannot be used", reason=str(error))
            except Exception:  # noqa: BLE001 - an unexpected error must not end maintenance
                _log.exception("maintenance of jobs failed")

    async def _take_over(self) -> None:
        names = await self._database.read(repository.runners)
        ended = await self._ended(names)
        if not ended:
            return
        failed = await self._database.write(
            repository.requeue_all_of, ended, self._completion.max_attempts
        )
        _log.warning("jobs of an ended process taken over", failed=len(failed))
        for job in failed:
            await self._completion.fail(job, job.runner or "", crash_problem(job))

    async def _expire(self) -> None:
        for job_id in await self._database.free(repository.expire, clock.deletion_time()):
            await asyncio.to_thread(self._files.remove_result, job_id)
            self._telemetry.jobs.labels("expired").inc()

    async def _sweep(self, made_before: float) -> None:
        """Remove files that no job needs and that were modified before a past time."""
        inputs, results = await self._database.read(repository.wanted_files)
        removed = await asyncio.to_thread(
            self._files.sweep, inputs, results, made_before, self._lock.is_alive
        )
        if removed:
            _log.info("unused files of jobs removed", files=removed)
