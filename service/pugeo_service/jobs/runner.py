# SPDX-License-Identifier: Apache-2.0
"""Runner: takes jobs from the queue and executes some at a time."""

import asyncio
import contextlib
from collections.abc import Callable

import structlog

from pugeo_service.engine import Engine
from pugeo_service.jobs import clock, repository
from pugeo_service.jobs.completion import Completion, crash_problem
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.execution import Execution
from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["Runner"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
# Interval in which jobs of other processes, and jobs with a start time, are found.
_POLL_S = 1.0
# Interval in which progress is stored, and a cancellation by another process is noticed.
_PROGRESS_S = 0.5
# A job that was claimed more recently may not be known here yet.
_UNKNOWN_S = 30.0


class Runner:
    """Executes jobs until it is drained.

    Args:
        name: name of this process.
        limit: maximum number of running jobs.
        engine: has the workers.
        database: database of jobs.
        make_execution: makes the execution of a job.
        completion: stores the outcome of an execution.
        on_change: called whenever a job has changed.
    """

    def __init__(
        self,
        name: str,
        limit: int,
        engine: Engine,
        database: Database,
        make_execution: Callable[[Job], Execution],
        completion: Completion,
        on_change: Callable[[], None],
    ) -> None:
        self._name = name
        self._limit = limit
        self._engine = engine
        self._database = database
        self._make_execution = make_execution
        self._completion = completion
        self._on_change = on_change
        self._stop_events: dict[str, asyncio.Event] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._wake = asyncio.Event()
        self._draining = False

    def wake(self) -> None:
        """Look for a job now, because one was accepted."""
        self._wake.set()

    def stop_job(self, job_id: str) -> None:
        """Stop a cancelled job if this process runs it."""
        if job_id in self._stop_events:
            self._stop_events[job_id].set()

    def drain(self) -> None:
        """Start no further jobs, and queue the running ones again."""
        self._draining = True
        self._completion.shutting_down = True
        for stop in self._stop_events.values():
            stop.set()
        self._wake.set()

    async def run(self) -> None:
        """Execute jobs until `drain`; return once the running ones are queued again."""
        while not self._draining:
            try:
                await self._start_jobs()
            except ProblemError:
                # Logged by the database; the next poll tries again.
                self._wake.clear()
            except Exception:  # noqa: BLE001 - an unexpected error must not end the runner
                _log.exception("jobs cannot be started")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_S):
                    await self._wake.wait()
            self._wake.clear()
        await asyncio.gather(*self._tasks)

    async def requeue_unknown(self) -> None:
        """Queue jobs again that the database assigns to this process but that do not run here.

        The response to a claim may have been lost.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        before = clock.now() - _UNKNOWN_S
        if await self._database.write(
            repository.requeue_unknown, self._name, list(self._stop_events), before
        ):
            _log.warning("jobs without an execution queued again")
            self.wake()

    async def _start_jobs(self) -> None:
        """Claim and start jobs up to the limit."""
        while (
            len(self._tasks) < self._limit
            and self._engine.status.workers
            and not self._draining
            and (job := await self._database.write(repository.claim, self._name, clock.now()))
        ):
            self._stop_events[job.id] = asyncio.Event()
            if self._draining:
                self._stop_events[job.id].set()
            task = asyncio.create_task(self._run(job, self._stop_events[job.id]))
            self._tasks.add(task)
            task.add_done_callback(self._ended)

    def _ended(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        self._wake.set()

    async def _run(self, job: Job, stop: asyncio.Event) -> None:
        waited = round(clock.now() - job.created_at, 3)
        with structlog.contextvars.bound_contextvars(job=job.id, request_id=job.request_id):
            _log.info("job started", attempt=job.attempts, waited_s=waited)
            self._on_change()
            try:
                if job.attempts > self._completion.max_attempts:
                    await self._completion.fail(job, self._name, crash_problem(job))
                    return
                execution = self._make_execution(job)
                work = asyncio.create_task(execution.run())
                try:
                    await self._monitor(job, execution, work, stop)
                finally:
                    work.cancel()
                    await asyncio.gather(work, return_exceptions=True)
                await self._completion(job, work)
            except ProblemError:
                # It stays assigned to this process; another takes it over after the end.
                _log.error("outcome of a job could not be stored")
            except Exception:  # noqa: BLE001 - `requeue_unknown` queues it again
                _log.exception("job ended unexpectedly")
            finally:
                # A job that was queued again may already run anew, with another event.
                if self._stop_events.get(job.id) is stop:
                    del self._stop_events[job.id]
                self._on_change()

    async def _monitor(
        self, job: Job, execution: Execution, work: "asyncio.Task[object]", stop: asyncio.Event
    ) -> None:
        """Store progress until the work has ended or must stop."""
        stopping = asyncio.create_task(stop.wait())
        stored = None
        try:
            while True:
                await asyncio.wait(
                    {work, stopping}, timeout=_PROGRESS_S, return_when=asyncio.FIRST_COMPLETED
                )
                if work.done() or stopping.done():
                    return
                now = execution.progress
                try:
                    owned = await self._store_progress(job, now if now != stored else None)
                except ProblemError:
                    continue
                if not owned:
                    return
                if now != stored:
                    stored = now
                    self._on_change()
        finally:
            stopping.cancel()

    async def _store_progress(self, job: Job, progress: tuple[str, int, int | None] | None) -> bool:
        """Store progress, if any; return False if the job no longer belongs to this process."""
        if progress is not None:
            return await self._database.write(
                repository.update_progress, job.id, self._name, *progress
            )
        found = await self._database.read(repository.find_many, [job.id])
        return bool(found) and found[0].runner == self._name
