# SPDX-License-Identifier: Apache-2.0
"""One attempt at a job: from the bytes of its input to those of its result on disk."""

import asyncio

from pugeo_service.admission.admission import Admission, Hold
from pugeo_service.engine import Engine, RunRequest, RunResult
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.models import Job, Success
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.runs import count_run, engine_problems, make_run_request
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problems

__all__ = ["Attempt"]

_ROOM_S = 0.5


class Attempt:
    """Works on a job; knows nothing of databases.

    Args:
        job: which.
        settings: limits.
        engine: does the work.
        admission: the account of jobs in the queue.
        files: where input and result are.
        telemetry: counts a run that succeeded.
        model: ``version`` and ``sha256`` of the weights.
    """

    def __init__(
        self,
        job: Job,
        *,
        settings: Settings,
        engine: Engine,
        admission: Admission,
        files: JobFiles,
        telemetry: Telemetry,
        model: dict[str, str],
    ) -> None:
        self._job = job
        self._settings = settings
        self._engine = engine
        self._admission = admission
        self._files = files
        self._telemetry = telemetry
        self._model = model
        self._stage = job.stage
        self._done = 0
        self._total: int | None = None

    @property
    def progress(self) -> tuple[str, int, int | None]:
        """The stage, patches done, and patches in all once they are known."""
        return self._stage, self._done, self._total

    async def run(self) -> Success:
        """Do it; cancelling this cancels its tasks.

        Raises:
            CloudError: the input cannot be used.
            InputLostError: it is not there any more.
            ProblemError: 422 for what the workers cannot do, 503 where they or the disk fail, 504
                where the time of a job is over.
        """
        with await self._admitted() as hold:
            outcome = await self._upsampled(hold)
            with outcome.spool:
                return await self._kept(outcome)

    async def _admitted(self) -> Hold:
        """Wait until the patches of all jobs that run leave room for these."""
        patches = RunRequest.estimate(self._job.input_bytes, self._job.format)
        while True:
            try:
                hold = self._admission.hold()
                hold.enter(patches)
            except ProblemError:
                await asyncio.sleep(_ROOM_S)
            else:
                return hold

    async def _upsampled(self, hold: Hold) -> RunResult:
        job, settings = self._job, self._settings
        order = make_run_request(
            settings,
            UpsampleQuery(**job.options).for_model(),
            format=job.format,
            answer=job.answer,
            deadline_s=settings.jobs_deadline_s,
            background=True,
        )

        def on_stage(stage: str) -> None:
            self._stage = stage

        def on_patches(count: int) -> None:
            self._total, self._done = count, 0
            hold.resize(count)

        def on_done(count: int) -> None:
            self._done += count
            hold.finish(count)

        body = self._files.input(job.id, job.input_bytes, job.input_sha256)
        try:
            async with asyncio.timeout(settings.jobs_deadline_s):
                with engine_problems():
                    return await self._engine.run(
                        body, order, on_patches=on_patches, on_done=on_done, on_stage=on_stage
                    )
        except TimeoutError as error:
            detail = f"The job took longer than {settings.jobs_deadline_s:g} s, its limit."
            fields = {"limit": settings.jobs_deadline_s}
            raise ProblemError(504, "deadline_exceeded", detail, fields=fields) from error

    async def _kept(self, outcome: RunResult) -> Success:
        with storage_problems(), self._files.new_result(self._job.id) as file:
            async for data in outcome.spool.chunks():
                await file.write(data)
            await file.commit()
        count_run(self._telemetry, outcome)
        return Success(
            size=file.size,
            sha256=file.sha256,
            report=outcome.report,
            timings=outcome.seconds,
            model=self._model,
            patches=self._total or 0,
        )
