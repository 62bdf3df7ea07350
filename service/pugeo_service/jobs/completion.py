# SPDX-License-Identifier: Apache-2.0
"""How an attempt at a job ended, and what that means for the job."""

import asyncio
import time
from typing import Any

import structlog

from pugeo_model.errors import CloudError
from pugeo_service.jobs import client_queries, runner_queries
from pugeo_service.jobs.database import Database, Work
from pugeo_service.jobs.files import InputLostError, JobFiles
from pugeo_service.jobs.models import ACTIVE, Job, Success
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError, bug

__all__ = ["Settlement", "crashed"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_ENGINE_BACK_S = 5.0
_STORAGE_BACK_S = 30.0
_AGAIN_S = 1.0
_OUR_DISK = frozenset({"storage_full", "storage_failed"})


def crashed(job: Job) -> ProblemError:
    """Return why a job that was running whenever the service died is not begun again."""
    detail = (
        f"The service ended {job.attempts} times while it worked on this job, which may be the "
        "cause. A smaller cloud or a lower R may work; the same will not be tried again."
    )
    return ProblemError(
        422, "job_crashed", detail, retryable=False, fields={"attempts": job.attempts}
    )


class Settlement:
    """Notes the end of attempts.

    Args:
        runner: name of this process.
        database: where jobs are.
        files: where their inputs and results are.
        telemetry: counts ends.
        ttl_s: seconds that results are kept.
        most_attempts: a job that was begun so often and never came to an end is taken for the
            cause.

    Attributes:
        hurry: a database that fails is not asked again.
    """

    def __init__(
        self,
        runner: str,
        database: Database,
        files: JobFiles,
        telemetry: Telemetry,
        ttl_s: float,
        most_attempts: int,
    ) -> None:
        self._runner = runner
        self._database = database
        self._files = files
        self._telemetry = telemetry
        self._ttl_s = ttl_s
        self.most_attempts = most_attempts
        self.hurry = False

    async def __call__(self, job: Job, work: "asyncio.Task[Success]") -> None:
        """Note what became of ``work``, which is over.

        Raises:
            ProblemError: 503, the database could not be told; the job is found again later.
        """
        try:
            success = work.result()
        except asyncio.CancelledError:
            await self._stopped(job)
        except Exception as error:  # noqa: BLE001 - whatever it is, the job must learn of it
            await self._failed(job, _problem_of(error))
        else:
            await self._succeeded(job, success)

    async def fail(self, job: Job, runner: str, problem: ProblemError) -> None:
        """End a job of ``runner`` with a problem."""
        now = time.time()
        members = problem.members(f"/jobs/{job.id}", job.request_id)
        ended = await self._insist(
            runner_queries.fail, job.id, runner, members, now, now + self._ttl_s
        )
        if ended:
            self._telemetry.jobs.labels("failed").inc()
            _log.warning("job failed", code=problem.code, detail=problem.detail[:200])
        await self._clean(job)

    async def _succeeded(self, job: Job, success: Success) -> None:
        now = time.time()
        expires_at = now + self._ttl_s
        ended = await self._insist(
            runner_queries.succeed, job.id, self._runner, success, now, expires_at
        )
        if ended:
            self._telemetry.jobs.labels("succeeded").inc()
            seconds = round(now - (job.started_at or now), 3)
            _log.info("job finished", points_out=success.report["points_out"], seconds=seconds)
        await self._clean(job)

    async def _stopped(self, job: Job) -> None:
        """The service drains, and did not die of this job; or the job was cancelled."""
        if await self._insist(
            runner_queries.give_back, job.id, self._runner, job.attempts - 1, 0.0
        ):
            self._telemetry.cancelled.labels("shutdown").inc()
            _log.info("job parked")
        else:
            self._telemetry.cancelled.labels("delete").inc()
            _log.info("job stopped")
            await self._clean(job)

    async def _failed(self, job: Job, problem: ProblemError) -> None:
        now = time.time()
        if problem.code == "engine_lost":
            again = (job.attempts - 1, now + _ENGINE_BACK_S)
        elif problem.code in _OUR_DISK and job.attempts < self.most_attempts:
            again = (job.attempts, now + _STORAGE_BACK_S)
        else:
            await self.fail(job, self._runner, problem)
            return
        _log.warning("job put back", code=problem.code)
        if not await self._insist(runner_queries.give_back, job.id, self._runner, *again):
            await self._clean(job)

    async def _clean(self, job: Job) -> None:
        """Remove the files that the job, as it is now, does not need.

        Those of a job that is not finished stay, its result too: another process may be about to
        put one there.
        """
        found = await self._database.read(client_queries.many, [job.id])
        state = found[0].state if found else "expired"
        if state in ACTIVE:
            return
        await asyncio.to_thread(self._files.remove_input, job.id)
        if state != "succeeded":
            await asyncio.to_thread(self._files.remove_result, job.id)

    async def _insist(self, work: Work[Any, bool], *args: Any) -> bool:
        """Write, and try again while the database fails."""
        while True:
            try:
                return await self._database.write(work, *args)
            except ProblemError:
                if self.hurry:
                    raise
                await asyncio.sleep(_AGAIN_S)


def _problem_of(error: Exception) -> ProblemError:
    if isinstance(error, ProblemError):
        return error
    if isinstance(error, CloudError):
        return ProblemError.from_cloud_error(error)
    if isinstance(error, InputLostError):
        _log.error("the input of a job is lost", reason=str(error))
        detail = f"The service lost the input of this job: {error}. Send it again."
        return ProblemError(500, "input_lost", detail, retryable=True)
    _log.error("unexpected error", exc_info=error)
    return bug()
