# SPDX-License-Identifier: Apache-2.0
"""Completion of an execution: success, failure, or another attempt."""

import asyncio
from typing import Any

import structlog

from pugeo_model.errors import CloudError
from pugeo_service.jobs import clock, repository
from pugeo_service.jobs.database import Database, Work
from pugeo_service.jobs.files import InputLostError, JobFiles
from pugeo_service.jobs.models import ACTIVE, Job, Success
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError, bug

__all__ = ["Completion", "crash_problem"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_ENGINE_RETRY_S = 5.0
_REPAIR_S = 30.0
_DATABASE_RETRY_S = 1.0
# Faults of the machines, which somebody may mend.
_REPAIRABLE = frozenset({"storage_full", "storage_failed", "wrong_weights"})


def crash_problem(job: Job) -> ProblemError:
    """Return the problem of a job that was running at too many crashes of the service."""
    detail = (
        f"The service crashed {job.attempts} times while it ran this job, which may be the cause. "
        "Send a smaller cloud or lower R; the same job will not be started again."
    )
    return ProblemError(
        422, "job_crashed", detail, retryable=False, fields={"attempts": job.attempts}
    )


class Completion:
    """Stores the outcome of executions.

    Args:
        runner: name of this process.
        database: database of jobs.
        files: files of jobs.
        telemetry: counts outcomes.
        ttl_s: seconds until a result is deleted.
        max_attempts: number of starts without an end after which a job fails, because it may be
            the cause of the crashes.

    Attributes:
        shutting_down: failed database writes are not repeated.
    """

    def __init__(
        self,
        runner: str,
        database: Database,
        files: JobFiles,
        telemetry: Telemetry,
        ttl_s: float,
        max_attempts: int,
    ) -> None:
        self._runner = runner
        self._database = database
        self._files = files
        self._telemetry = telemetry
        self._ttl_s = ttl_s
        self.max_attempts = max_attempts
        self.shutting_down = False

    async def __call__(self, job: Job, work: "asyncio.Task[Success]") -> None:
        """Store the outcome of ``work``, which has ended.

        Raises:
            ProblemError: 503, the outcome could not be stored; maintenance finds the job later.
        """
        try:
            success = work.result()
        except asyncio.CancelledError:
            await self._cancelled(job)
        except Exception as error:  # noqa: BLE001 - each error ends the job as failed
            await self._failed(job, _problem_of(error))
        else:
            await self._succeeded(job, success)

    async def fail(self, job: Job, runner: str, problem: ProblemError) -> None:
        """End a job of ``runner`` with a problem."""
        now = clock.now()
        members = problem.members(f"/jobs/{job.id}", job.request_id)
        ended = await self._write(repository.fail, job.id, runner, members, now, now + self._ttl_s)
        if ended:
            self._telemetry.jobs.labels("failed").inc()
            _log.warning("job failed", code=problem.code, detail=problem.detail[:200])
        await self._remove_files(job)

    async def _succeeded(self, job: Job, success: Success) -> None:
        now = clock.now()
        expires_at = now + self._ttl_s
        ended = await self._write(
            repository.succeed, job.id, self._runner, success, now, expires_at
        )
        if ended:
            self._telemetry.jobs.labels("succeeded").inc()
            seconds = round(now - (job.started_at or now), 3)
            _log.info("job finished", points_out=success.report["points_out"], seconds=seconds)
        await self._remove_files(job)

    async def _cancelled(self, job: Job) -> None:
        """Queue the job again after a shutdown; remove its files if it was cancelled."""
        if await self._write(repository.requeue, job.id, self._runner, job.attempts - 1, 0.0):
            self._telemetry.cancelled.labels("shutdown").inc()
            _log.info("job queued again")
        else:
            self._telemetry.cancelled.labels("delete").inc()
            _log.info("job cancelled")
            await self._remove_files(job)

    async def _failed(self, job: Job, problem: ProblemError) -> None:
        now = clock.now()
        if problem.code == "engine_lost":
            retry = (job.attempts - 1, now + _ENGINE_RETRY_S)
        elif problem.code in _REPAIRABLE and job.attempts < self.max_attempts:
            retry = (job.attempts, now + _REPAIR_S)
        else:
            await self.fail(job, self._runner, problem)
            return
        _log.warning("job queued again after an error", code=problem.code)
        if not await self._write(repository.requeue, job.id, self._runner, *retry):
            await self._remove_files(job)

    async def _remove_files(self, job: Job) -> None:
        """Remove files that the job no longer needs in its present state.

        Files of an active job are kept, including a result that another process may have stored.
        """
        found = await self._database.read(repository.find_many, [job.id])
        state = found[0].state if found else "expired"
        if state in ACTIVE:
            return
        await asyncio.to_thread(self._files.remove_input, job.id)
        if state != "succeeded":
            await asyncio.to_thread(self._files.remove_result, job.id)

    async def _write(self, work: Work[Any, bool], *args: Any) -> bool:
        """Run a writing query; repeat it while the database fails."""
        while True:
            try:
                # The end of a job gives back the room of its input.
                return await self._database.free(work, *args)
            except ProblemError:
                if self.shutting_down:
                    raise
                await asyncio.sleep(_DATABASE_RETRY_S)


def _problem_of(error: Exception) -> ProblemError:
    if isinstance(error, ProblemError):
        return error
    if isinstance(error, CloudError):
        return ProblemError.from_cloud_error(error)
    if isinstance(error, InputLostError):
        _log.error("input of a job is lost", reason=str(error))
        detail = f"The service lost the input of this job: {error}. Send it again."
        return ProblemError(500, "input_lost", detail, retryable=True)
    _log.error("unexpected error", exc_info=error)
    return bug()
