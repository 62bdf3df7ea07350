# SPDX-License-Identifier: Apache-2.0
"""Execution of a job, from its input file to its result file."""

import asyncio

from pugeo_service.admission.admission import Admission, Reservation
from pugeo_service.engine import Engine, RunRequest, RunResult
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.models import Job, Success
from pugeo_service.models import Models, ServedModel
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.runs import count_run, engine_problems, make_run_request
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problems

__all__ = ["Execution"]

_ADMISSION_RETRY_S = 0.5


class Execution:
    """Runs a job once; does not access the database.

    Args:
        job: job to run.
        settings: limits.
        engine: runs the request.
        admission: queue of jobs.
        files: files of jobs.
        telemetry: counts successful runs.
        models: models by name.
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
        models: Models,
    ) -> None:
        self._job = job
        self._settings = settings
        self._engine = engine
        self._admission = admission
        self._files = files
        self._telemetry = telemetry
        self._models = models
        self._stage = job.stage
        self._done = 0
        self._total: int | None = None

    @property
    def progress(self) -> tuple[str, int, int | None]:
        """Stage, number of finished patches, and number of patches if it is known."""
        return self._stage, self._done, self._total

    async def run(self) -> Success:
        """Run the job; cancelling this cancels its tasks.

        Raises:
            CloudError: the input cannot be used.
            InputLostError: the input file is missing or changed.
            ProblemError: 422 the cloud is too much for a worker, or its model is gone, 503 workers
                or disk fail, 504 the time limit of jobs is exceeded.
        """
        # By chance, but the same one at each attempt.
        chance = int(self._job.id[-8:], 16) / 2**32
        model = self._models.choose(self._job.options.get("model"), None, chance)
        with await self._admit() as reservation:
            result = await self._upsample(reservation, model)
            with result.spool:
                return await self._store(result, model)

    async def _admit(self) -> Reservation:
        """Wait until the queue of jobs has room for the patches of this one."""
        patches = RunRequest.estimate(self._job.input_bytes, self._job.format)
        while True:
            try:
                reservation = self._admission.reserve()
                reservation.admit(patches)
            except ProblemError:
                await asyncio.sleep(_ADMISSION_RETRY_S)
            else:
                return reservation

    async def _upsample(self, reservation: Reservation, model: ServedModel) -> RunResult:
        job, settings = self._job, self._settings
        run_request = make_run_request(
            settings,
            UpsampleQuery(**job.options).for_model(),
            model=model.id,
            format=job.format,
            answer=job.answer,
            deadline_s=settings.jobs_deadline_s,
            background=True,
        )

        def on_stage(stage: str) -> None:
            self._stage = stage

        def on_patches(count: int) -> None:
            self._total, self._done = count, 0
            reservation.set_patches(count)

        def on_done(count: int) -> None:
            self._done += count
            reservation.finish(count)

        body = self._files.input(job.id, job.input_bytes, job.input_sha256)
        try:
            async with asyncio.timeout(settings.jobs_deadline_s):
                with engine_problems():
                    return await self._engine.run(
                        body, run_request, on_patches=on_patches, on_done=on_done, on_stage=on_stage
                    )
        except TimeoutError as error:
            detail = (
                f"The job exceeded the limit of {settings.jobs_deadline_s:g} s for jobs, which "
                "PUGEO_JOBS_DEADLINE_S raises."
            )
            fields = {"limit": settings.jobs_deadline_s, "setting": "PUGEO_JOBS_DEADLINE_S"}
            raise ProblemError(504, "deadline_exceeded", detail, fields=fields) from error

    async def _store(self, result: RunResult, model: ServedModel) -> Success:
        with storage_problems(), self._files.new_result(self._job.id) as file:
            async for data in result.spool.chunks():
                await file.write(data)
            await file.commit()
        count_run(self._telemetry, result, model.described)
        return Success(
            size=file.size,
            sha256=file.sha256,
            report=result.report,
            timings=result.seconds,
            model=model.described,
            patches=self._total or 0,
        )
