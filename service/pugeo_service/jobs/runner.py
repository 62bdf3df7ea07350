# SPDX-License-Identifier: Apache-2.0
"""What takes jobs from the queue and runs them, a few at a time."""

import asyncio
import contextlib
import time
from collections.abc import Callable

import structlog

from pugeo_service.engine import Engine
from pugeo_service.jobs import client_queries, runner_queries
from pugeo_service.jobs.completion import Settlement, crashed
from pugeo_service.jobs.database import Database
from pugeo_service.jobs.execution import Attempt
from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["Runner"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
# Work that another process accepted, or that waits for its time, is found after so long.
_LOOK_S = 1.0
# Progress is noted, and another process's cancellation seen, so often.
_TICK_S = 0.5
# What was claimed a moment ago may not be known here yet.
_STRAY_S = 30.0


class Runner:
    """Runs jobs while it is told to.

    Args:
        name: of this process.
        limit: jobs that run at one time.
        engine: where they run.
        database: where they are.
        attempt: makes the work of a job.
        settle: notes how it ended.
        changed: is called whenever a job has changed.
    """

    def __init__(
        self,
        name: str,
        limit: int,
        engine: Engine,
        database: Database,
        attempt: Callable[[Job], Attempt],
        settle: Settlement,
        changed: Callable[[], None],
    ) -> None:
        self._name = name
        self._limit = limit
        self._engine = engine
        self._database = database
        self._attempt = attempt
        self._settle = settle
        self._changed = changed
        self._halts: dict[str, asyncio.Event] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._wake = asyncio.Event()
        self._draining = False

    def wake(self) -> None:
        """Look for work now: a job was accepted."""
        self._wake.set()

    def halt(self, job_id: str) -> bool:
        """Stop working on a job that was cancelled; return whether this process runs it."""
        if job_id not in self._halts:
            return False
        self._halts[job_id].set()
        return True

    def drain(self) -> None:
        """Begin nothing more, and give back what runs."""
        self._draining = True
        self._settle.hurry = True
        for halt in self._halts.values():
            halt.set()
        self._wake.set()

    async def run(self) -> None:
        """Run jobs until `drain`, and then until those that ran are given back."""
        while not self._draining:
            try:
                await self._begin()
            except ProblemError:
                # The database's log line says why; it may be back at the next look.
                self._wake.clear()
            except Exception:  # noqa: BLE001 - a bug must not end all jobs for good
                _log.exception("jobs cannot be begun")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_S):
                    await self._wake.wait()
            self._wake.clear()
        await asyncio.gather(*self._tasks)

    async def reclaim(self) -> None:
        """Put back what is marked as run here and is not, say since the answer to a claim was lost.

        Raises:
            ProblemError: 503, the database cannot be used.
        """
        before = time.time() - _STRAY_S
        if await self._database.write(
            runner_queries.put_back, self._name, list(self._halts), before
        ):
            _log.warning("jobs that nobody ran are queued again")
            self.wake()

    async def _begin(self) -> None:
        """Take as many jobs as may run."""
        while (
            len(self._tasks) < self._limit
            and self._engine.status.workers
            and not self._draining
            and (job := await self._database.write(runner_queries.claim, self._name, time.time()))
        ):
            self._halts[job.id] = asyncio.Event()
            if self._draining:
                self._halts[job.id].set()
            task = asyncio.create_task(self._run(job, self._halts[job.id]))
            self._tasks.add(task)
            task.add_done_callback(self._ended)

    def _ended(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        self._wake.set()

    async def _run(self, job: Job, halt: asyncio.Event) -> None:
        waited = round(time.time() - job.created_at, 3)
        with structlog.contextvars.bound_contextvars(job=job.id, request_id=job.request_id):
            _log.info("job started", attempt=job.attempts, waited_s=waited)
            self._changed()
            try:
                if job.attempts > self._settle.most_attempts:
                    await self._settle.fail(job, self._name, crashed(job))
                    return
                attempt = self._attempt(job)
                work = asyncio.create_task(attempt.run())
                try:
                    await self._attend(job, attempt, work, halt)
                finally:
                    work.cancel()
                    await asyncio.gather(work, return_exceptions=True)
                await self._settle(job, work)
            except ProblemError:
                # It stays this process's, and is taken up again once that has ended.
                _log.error("the end of a job could not be noted")
            except Exception:  # noqa: BLE001 - `reclaim` takes it up again
                _log.exception("a job was left behind")
            finally:
                # Given back, the job may have been begun anew: that one's event stays.
                if self._halts.get(job.id) is halt:
                    del self._halts[job.id]
                self._changed()

    async def _attend(
        self, job: Job, attempt: Attempt, work: "asyncio.Task[object]", halt: asyncio.Event
    ) -> None:
        """Note progress until the work is done, or somebody wants it to end."""
        halted = asyncio.create_task(halt.wait())
        noted = None
        try:
            while True:
                await asyncio.wait(
                    {work, halted}, timeout=_TICK_S, return_when=asyncio.FIRST_COMPLETED
                )
                if work.done() or halted.done():
                    return
                now = attempt.progress
                try:
                    mine = await self._note(job, now if now != noted else None)
                except ProblemError:
                    continue
                if not mine:
                    return
                if now != noted:
                    noted = now
                    self._changed()
        finally:
            halted.cancel()

    async def _note(self, job: Job, progress: tuple[str, int, int | None] | None) -> bool:
        """Write progress down if there is any; return whether the job is still ours."""
        if progress is not None:
            return await self._database.write(
                runner_queries.progress, job.id, self._name, *progress
            )
        found = await self._database.read(client_queries.many, [job.id])
        return bool(found) and found[0].runner == self._name
