# SPDX-License-Identifier: Apache-2.0
"""Job manager: the interface of jobs for the routes, and their life cycle."""

import asyncio
import functools
import shutil
from collections.abc import Callable

import structlog
from starlette.requests import Request

from pugeo_service.admission.admission import Admission
from pugeo_service.engine import Engine
from pugeo_service.http.negotiation import OutputChoice
from pugeo_service.http.query import JobQuery
from pugeo_service.jobs import clock, repository
from pugeo_service.jobs.change_feed import ChangeFeed
from pugeo_service.jobs.completion import Completion
from pugeo_service.jobs.database import Database, unavailable
from pugeo_service.jobs.execution import Execution
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.maintenance import Maintenance
from pugeo_service.jobs.models import Job, State, is_id
from pugeo_service.jobs.process_lock import ProcessLock
from pugeo_service.jobs.repository import JobUsage
from pugeo_service.jobs.runner import Runner
from pugeo_service.jobs.runner_beats import RunnerBeats
from pugeo_service.jobs.stored_files import StoredJobFiles
from pugeo_service.jobs.submission import Submission
from pugeo_service.jobs.webhooks import Webhooks
from pugeo_service.models import Models
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.reserve import Reserve

__all__ = ["JobManager"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_REOPEN_S = 5.0
# Finished jobs of an owner whose rows are kept at least.
_LEAST_ROWS = 1000


class JobManager:
    """All jobs of one process. Its methods must be called in the event loop of the front.

    Args:
        settings: settings of the service.
        engine: runs jobs.
        telemetry: counts jobs.
        models: models by name.
        keys_version: returns another value after API keys have changed.

    Attributes:
        admission: queue of running jobs. It is separate from the queue of requests, so that jobs
            never cause the refusal of a request.
        uploads: bounds the bodies of jobs that are being received.
        changes: feed of changed jobs.
        files: files of jobs.
    """

    def __init__(
        self,
        settings: Settings,
        engine: Engine,
        telemetry: Telemetry,
        models: Models,
        keys_version: Callable[[], object],
    ) -> None:
        self._folder = settings.jobs_folder
        self._settings = settings
        self._telemetry = telemetry
        self._lock = ProcessLock(self._folder)
        self.files = (
            JobFiles(self._folder, self._lock.name)
            if settings.jobs_store is None
            else StoredJobFiles(self._folder, self._lock.name, settings.jobs_store)
        )
        self._reserve = Reserve(self._folder / "reserve")
        self._database = Database(settings.jobs_database, self._reserve)
        # Locks on files show which processes run, where all share a folder.
        self._beats = (
            RunnerBeats(self._database, self._lock.name)
            if settings.fronts_share_no_folder
            else None
        )
        self.admission = Admission(
            settings.queue_patches, settings.queue_bytes, settings.jobs_running
        )
        self.uploads = Admission(
            settings.queue_patches, settings.queue_bytes, settings.queue_requests
        )
        self.changes = ChangeFeed(
            lambda ids: self._database.read(repository.revisions, ids),
            lambda ids: self._database.read(repository.find_many, ids),
            keys_version,
        )
        self._submission = Submission(settings, self._database, self.files, self.uploads, models)
        completion = Completion(
            self._lock.name,
            self._database,
            self.files,
            telemetry,
            settings.jobs_ttl_s,
            settings.jobs_attempts,
        )
        make_execution = functools.partial(
            Execution,
            settings=settings,
            engine=engine,
            admission=self.admission,
            files=self.files,
            telemetry=telemetry,
            models=models,
        )
        self._runner = Runner(
            self._lock.name,
            settings.jobs_running,
            engine,
            self._database,
            make_execution,
            completion,
            self.changes.notify,
        )
        self._maintenance = Maintenance(
            self._database,
            self.files,
            self._lock,
            completion,
            telemetry,
            self._runner.requeue_unknown,
            self._reserve,
            max(_LEAST_ROWS, settings.jobs_queue),
            None if self._beats is None else self._beats.ended,
        )
        self._webhooks: Webhooks | None = None
        if settings.webhook_secret is not None:
            self._webhooks = Webhooks(
                self._database,
                settings.webhook_secret,
                private=settings.webhook_private,
                telemetry=telemetry,
            )
        self._tasks: list[asyncio.Task[None]] = []
        self._opening: asyncio.Task[None] | None = None
        self._ready = False

    @property
    def usage(self) -> JobUsage:
        """Use of the capacity for jobs, at most some seconds old."""
        return self._maintenance.usage

    async def start(self) -> None:
        """Open folder and database; return after the first attempt and repeat it if it failed."""
        if not await self._open():
            self._opening = asyncio.create_task(self._reopen())

    def drain(self) -> None:
        """Refuse new jobs, queue running ones again, end all event streams."""
        self.uploads.draining = True
        self._runner.drain()
        self.changes.close()

    async def stop(self) -> None:
        """Stop; running jobs are queued again."""
        self.drain()
        if self._opening is not None:
            self._opening.cancel()
            await asyncio.gather(self._opening, return_exceptions=True)
        if self._tasks:
            running, *others = self._tasks
            await running
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)
        self._ready = False
        if self._beats is not None:
            await self._beats.stop()
        await asyncio.to_thread(self._database.close)
        self._lock.release()
        if self._settings.jobs_folder_is_private:
            await asyncio.to_thread(shutil.rmtree, self._folder, ignore_errors=True)

    async def submit(
        self,
        request: Request,
        query: JobQuery,
        choice: OutputChoice,
        owner: str,
        key: str | None,
    ) -> tuple[Job, bool]:
        """Accept a job; see `Submission`."""
        self._check_ready()
        self.uploads.check_draining()
        job, new = await self._submission(request, query, choice, owner, key)
        if new:
            self._telemetry.jobs.labels("queued").inc()
            _log.info("job accepted", job=job.id, bytes_in=job.input_bytes)
            self._runner.wake()
        return job, new

    async def get(self, job_id: str, owner: str) -> Job:
        """Return a job.

        Raises:
            ProblemError: 404, or 503 if the database cannot be used.
        """
        self._check_ready()
        _check_id(job_id)
        job = await self._database.read(repository.find, job_id, owner)
        if job is None:
            raise _unknown_job(job_id)
        return job

    async def page(
        self, owner: str, state: State | None, before: str | None, limit: int
    ) -> tuple[list[Job], str | None]:
        """List jobs, newest first; return them with the cursor of the next page, if any.

        Raises:
            ProblemError: 404 for a cursor of another form, or 503 if the database cannot be used.
        """
        self._check_ready()
        if before is not None:
            _check_id(before)
        found = await self._database.read(repository.list_page, owner, state, before, limit + 1)
        readable = [job for _, job in found[:limit] if job is not None]
        return readable, found[limit - 1][0] if len(found) > limit else None

    async def withdraw(self, job_id: str, owner: str) -> Job:
        """Cancel an active job, or delete the result of a finished one. Idempotent.

        Raises:
            ProblemError: 404, or 503 if the database cannot be used.
        """
        self._check_ready()
        _check_id(job_id)
        now = clock.now()
        expires_at = now + self._settings.jobs_ttl_s
        found = await self._database.free(repository.withdraw, job_id, owner, now, expires_at)
        if found is None:
            raise _unknown_job(job_id)
        before, job = found
        if before.state != job.state:
            self._telemetry.jobs.labels(job.state).inc()
            _log.info("job withdrawn", job=job.id, previous_state=before.state)
            self.changes.notify()
        # The files of a running job are removed after the end of its execution.
        if before.state == "queued":
            await asyncio.to_thread(self.files.remove_input, job.id)
        elif before.state == "running":
            self._runner.stop_job(job.id)
        elif before.state == "succeeded":
            await asyncio.to_thread(self.files.remove_result, job.id)
        return job

    async def _open(self) -> bool:
        """Prepare folder and database, run maintenance, and start to run jobs."""
        try:
            await asyncio.to_thread(self.files.prepare)
            await asyncio.to_thread(self._lock.acquire)
            if self._beats is not None:
                await self._beats.beat()
            await self._maintenance.start()
        except OSError as error:
            _log.error("folder of jobs cannot be used", reason=str(error))
            return False
        except ProblemError:
            return False  # logged by the database
        tasks = [self._runner.run(), self._maintenance.run(), self.changes.run()]
        if self._webhooks is not None:
            tasks.append(self._webhooks.run())
        if self._beats is not None:
            tasks.append(self._beats.run())
        self._tasks = [asyncio.create_task(task) for task in tasks]
        self._ready = True
        _log.info("jobs available", folder=str(self._folder), queued=self.usage.queued)
        return True

    async def _reopen(self) -> None:
        while True:
            await asyncio.sleep(_REOPEN_S)
            if await self._open():
                return

    def _check_ready(self) -> None:
        if not self._ready:
            raise unavailable("folder or database error")


def _check_id(text: str) -> None:
    """Refuse an id or cursor of another form: PostgreSQL has no NUL, so it must not see one."""
    if not is_id(text):
        raise _unknown_job(text)


def _unknown_job(job_id: str) -> ProblemError:
    detail = f"There is no job {job_id[:64]!r}; jobs are removed a week after their result expired."
    return ProblemError(404, "unknown_job", detail)
