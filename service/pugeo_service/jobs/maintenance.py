# SPDX-License-Identifier: Apache-2.0
"""What has to be done for jobs from time to time, whether or not any runs here."""

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog

from pugeo_service.jobs import client_queries, runner_queries
from pugeo_service.jobs.client_queries import Usage
from pugeo_service.jobs.completion import Settlement, crashed
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.process_lock import Presence
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError

__all__ = ["Keeper"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_ROUND_S = 2.0
_SWEEP_S = 600.0
# A file whose row is not written yet is younger than this.
_ORPHAN_S = 3600.0
# A job is still known, and its key still honoured, for so long after its result is gone.
_REMEMBER_S = 7 * 86400.0


class Keeper:
    """Takes over the jobs of processes that died, lets results expire, removes orphans.

    Args:
        database: where jobs are.
        files: their files.
        presence: which processes live.
        settle: fails those that were begun too often.
        telemetry: counts what expired.
        reclaim: puts back jobs that this process was to run and does not.

    Attributes:
        usage: what jobs take up, some seconds old at most.
    """

    def __init__(
        self,
        database: Database,
        files: JobFiles,
        presence: Presence,
        settle: Settlement,
        telemetry: Telemetry,
        reclaim: Callable[[], Awaitable[None]],
    ) -> None:
        self._database = database
        self._files = files
        self._presence = presence
        self._settle = settle
        self._telemetry = telemetry
        self._reclaim = reclaim
        self.usage = Usage()

    async def begin(self) -> None:
        """Clear up after processes that died, before the first request is let in.

        Raises:
            ProblemError: 503, the database cannot be used.
            OSError: the folder cannot.
        """
        await self._take_over()
        # First the time: whatever a process that joins meanwhile makes is younger.
        now = time.time()
        alone = await asyncio.to_thread(lambda: self._presence.alone)
        await self._sweep(now if alone else now - _ORPHAN_S)
        self.usage = await self._database.read(client_queries.usage)

    async def run(self) -> None:
        """Go round until cancelled."""
        swept = time.monotonic()
        while True:
            await asyncio.sleep(_ROUND_S)
            try:
                await self._take_over()
                await self._reclaim()
                await self._expire()
                if time.monotonic() - swept > _SWEEP_S:
                    swept = time.monotonic()
                    await self._database.write(runner_queries.prune, time.time() - _REMEMBER_S)
                    await self._sweep(time.time() - _ORPHAN_S)
                self.usage = await self._database.read(client_queries.usage)
            except ProblemError:
                continue  # the database's own log line says why
            except OSError as error:
                _log.error("the folder of jobs fails", reason=str(error))
            except Exception:  # noqa: BLE001 - a bug must not end all jobs for good
                _log.exception("jobs are not kept")

    async def _take_over(self) -> None:
        names = await self._database.read(runner_queries.runners)
        dead = await asyncio.to_thread(self._presence.dead, names)
        if not dead:
            return
        spent = await self._database.write(runner_queries.release, dead, self._settle.most_attempts)
        _log.warning("jobs of a process that ended are taken over", given_up=len(spent))
        for job in spent:
            await self._settle.fail(job, job.runner or "", crashed(job))

    async def _expire(self) -> None:
        for job_id in await self._database.write(runner_queries.expire, time.time()):
            await asyncio.to_thread(self._files.remove_result, job_id)
            self._telemetry.jobs.labels("expired").inc()

    async def _sweep(self, youngest: float) -> None:
        """Remove files that no job needs and that were made by then, a time already past."""
        inputs, results = await self._database.read(runner_queries.wanted)
        removed = await asyncio.to_thread(
            self._files.sweep, inputs, results, youngest, self._presence.alive
        )
        if removed:
            _log.info("files that no job needs were removed", files=removed)
