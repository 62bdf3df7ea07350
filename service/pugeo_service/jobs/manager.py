# SPDX-License-Identifier: Apache-2.0
"""All of the jobs of one process: what the routes use, and what starts and ends with it."""

import asyncio
import functools
import shutil
import time

import structlog
from starlette.requests import Request

from pugeo_service.admission.admission import Admission
from pugeo_service.engine import Engine
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs import client_queries
from pugeo_service.jobs.change_feed import Watch
from pugeo_service.jobs.client_queries import Usage
from pugeo_service.jobs.completion import Settlement
from pugeo_service.jobs.database import Database, unavailable
from pugeo_service.jobs.execution import Attempt
from pugeo_service.jobs.files import JobFiles
from pugeo_service.jobs.maintenance import Keeper
from pugeo_service.jobs.models import Job, State
from pugeo_service.jobs.process_lock import Presence
from pugeo_service.jobs.runner import Runner
from pugeo_service.jobs.submission import Submission
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings

__all__ = ["Jobs"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
_AGAIN_S = 5.0


class Jobs:
    """The jobs API without HTTP. Its methods belong to the event loop of the front.

    Args:
        settings: of the service.
        engine: runs them.
        telemetry: counts them.
        model: ``version`` and ``sha256`` of the weights.

    Attributes:
        admission: the account of their patches in the queue. It is apart from that of requests,
            so that jobs, however large, keep no request out.
        arriving: the account of the bodies of jobs on their way.
        watch: who watches which job.
        files: where results are.
    """

    def __init__(
        self, settings: Settings, engine: Engine, telemetry: Telemetry, model: dict[str, str]
    ) -> None:
        self._folder = settings.jobs_folder
        self._settings = settings
        self._telemetry = telemetry
        self._presence = Presence(self._folder)
        self.files = JobFiles(self._folder, self._presence.name)
        self._database = Database(settings.jobs_database)
        self.admission = Admission(
            settings.queue_patches, settings.queue_bytes, settings.jobs_running
        )
        self.arriving = Admission(
            settings.queue_patches, settings.queue_bytes, settings.queue_requests
        )
        self.watch = Watch(lambda ids: self._database.read(client_queries.many, ids))
        self._submission = Submission(settings, self._database, self.files, self.arriving)
        settle = Settlement(
            self._presence.name,
            self._database,
            self.files,
            telemetry,
            settings.jobs_ttl_s,
            settings.jobs_attempts,
        )
        attempt = functools.partial(
            Attempt,
            settings=settings,
            engine=engine,
            admission=self.admission,
            files=self.files,
            telemetry=telemetry,
            model=model,
        )
        self._runner = Runner(
            self._presence.name,
            settings.jobs_running,
            engine,
            self._database,
            attempt,
            settle,
            self.watch.changed,
        )
        self._keeper = Keeper(
            self._database, self.files, self._presence, settle, telemetry, self._runner.reclaim
        )
        self._tasks: list[asyncio.Task[None]] = []
        self._opening: asyncio.Task[None] | None = None
        self._ready = False

    @property
    def usage(self) -> Usage:
        """What jobs take up, some seconds old at most."""
        return self._keeper.usage

    async def start(self) -> None:
        """Open folder and database; returns after the first try, which others may follow."""
        if not await self._open():
            self._opening = asyncio.create_task(self._keep_opening())

    def drain(self) -> None:
        """Take no more jobs, give back those that run, end all streams."""
        self.arriving.draining = True
        self._runner.drain()
        self.watch.close()

    async def stop(self) -> None:
        """End everything; jobs that run are queued again."""
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
        await asyncio.to_thread(self._database.close)
        self._presence.leave()
        if self._settings.jobs_folder_is_private:
            await asyncio.to_thread(shutil.rmtree, self._folder, ignore_errors=True)

    async def submit(
        self, request: Request, query: UpsampleQuery, answer: str, owner: str, key: str | None
    ) -> tuple[Job, bool]:
        """Take a job in; see `Submission`."""
        self._check_ready()
        self.arriving.check_draining()
        job, new = await self._submission(request, query, answer, owner, key)
        if new:
            self._telemetry.jobs.labels("queued").inc()
            _log.info("job accepted", job=job.id, bytes_in=job.input_bytes)
            self._runner.wake()
        return job, new

    async def get(self, job_id: str, owner: str) -> Job:
        """Return a job.

        Raises:
            ProblemError: 404, or 503 where the database cannot be used.
        """
        self._check_ready()
        job = await self._database.read(client_queries.get, job_id, owner)
        if job is None:
            raise _unknown(job_id)
        return job

    async def page(
        self, owner: str, state: State | None, before: str | None, limit: int
    ) -> tuple[list[Job], str | None]:
        """List jobs, newest first, and the cursor of the page after, if there is one."""
        self._check_ready()
        found = await self._database.read(client_queries.page, owner, state, before, limit + 1)
        more = len(found) > limit
        return found[:limit], found[limit - 1].id if more else None

    async def withdraw(self, job_id: str, owner: str) -> Job:
        """Cancel a job that is not finished, or delete the result of one that is.

        Raises:
            ProblemError: 404, or 503 where the database cannot be used.
        """
        self._check_ready()
        now = time.time()
        expires_at = now + self._settings.jobs_ttl_s
        found = await self._database.write(client_queries.withdraw, job_id, owner, now, expires_at)
        if found is None:
            raise _unknown(job_id)
        was, job = found
        if was.state != job.state:
            self._telemetry.jobs.labels(job.state).inc()
            _log.info("job withdrawn", job=job.id, was=was.state)
            self.watch.changed()
        # Whoever runs it removes its files once nobody reads them any more.
        if was.state == "queued":
            await asyncio.to_thread(self.files.remove_input, job.id)
        elif was.state == "running":
            self._runner.halt(job.id)
        elif was.state == "succeeded":
            await asyncio.to_thread(self.files.remove_result, job.id)
        return job

    async def _open(self) -> bool:
        """Make folder and database ready, clear up, and begin to run jobs."""
        try:
            await asyncio.to_thread(self.files.prepare)
            await asyncio.to_thread(self._presence.enter)
            await self._keeper.begin()
        except OSError as error:
            _log.error("the folder of jobs cannot be used", reason=str(error))
            return False
        except ProblemError:
            return False  # the database's own log line says why
        self._tasks = [
            asyncio.create_task(task)
            for task in (self._runner.run(), self._keeper.run(), self.watch.run())
        ]
        self._ready = True
        _log.info("jobs are open", folder=str(self._folder), queued=self.usage.queued)
        return True

    async def _keep_opening(self) -> None:
        while True:
            await asyncio.sleep(_AGAIN_S)
            if await self._open():
                return

    def _check_ready(self) -> None:
        if not self._ready:
            raise unavailable("their folder or database cannot be used")


def _unknown(job_id: str) -> ProblemError:
    detail = f"There is no job {job_id[:64]!r}; it may have been forgotten a week after its end."
    return ProblemError(404, "unknown_job", detail)
