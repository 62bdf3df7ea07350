# SPDX-License-Identifier: Apache-2.0
"""Queries of the table of jobs; each function runs within one transaction.

A running job belongs to the process named in ``runner``. Each update of a running job requires this
name and the state ``running``, so a process can never change a job that was cancelled or that
another process has taken over.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import structlog
from sqlalchemy import Connection, delete, func, insert, select, update

from pugeo_service.jobs.models import (
    ACTIVE,
    FINAL,
    Job,
    State,
    Success,
    UnreadableRowError,
    jobs,
)

__all__ = [
    "JobUsage", "add", "claim", "expire", "fail", "find", "find_by_key", "find_many", "list_page",
    "owner_usage", "prune", "prune_most", "requeue", "requeue_all_of", "requeue_unknown",
    "revisions", "runners", "succeed", "update_progress", "usage", "wanted_files", "withdraw",
]  # fmt: skip

_log = structlog.stdlib.get_logger("pugeo.jobs")
_ADD_LOCK = 0x70756765  # key of an advisory lock; any number


@dataclass(frozen=True)
class JobUsage:
    """Use of the capacity for jobs, by all jobs or by those of one owner.

    Attributes:
        queued: number of queued jobs.
        running: number of running jobs.
        bytes: bytes of inputs of both, and of stored results.
    """

    queued: int = 0
    running: int = 0
    bytes: int = 0

    @property
    def active(self) -> int:
        """Number of queued and running jobs."""
        return self.queued + self.running


def usage(connection: Connection, owner: str | None = None) -> JobUsage:
    """Compute the use of all jobs, or of the jobs of one owner."""
    query = (
        select(
            jobs.c.state,
            func.count(),
            func.coalesce(func.sum(jobs.c.input_bytes), 0),
            func.coalesce(func.sum(jobs.c.result_bytes), 0),
        )
        .where(jobs.c.state.in_((*ACTIVE, "succeeded")))
        .group_by(jobs.c.state)
    )
    if owner is not None:
        query = query.where(jobs.c.owner == owner)
    rows = connection.execute(query).all()
    by_state = {state: (count, int(inputs), int(results)) for state, count, inputs, results in rows}
    none = (0, 0, 0)
    queued, running = by_state.get("queued", none), by_state.get("running", none)
    kept = by_state.get("succeeded", none)[2]
    return JobUsage(queued[0], running[0], queued[1] + running[1] + kept)


def owner_usage(connection: Connection, owner: str) -> tuple[JobUsage, JobUsage]:
    """Compute the use of all jobs and that of one owner; ``""`` means all."""
    total = usage(connection)
    return total, usage(connection, owner) if owner else total


def add(connection: Connection, job: Job, check: Callable[[JobUsage, JobUsage], None]) -> None:
    """Insert a new job if its owner and the service have capacity for it.

    Args:
        connection: of a writing transaction.
        job: the new one.
        check: called with the use of all jobs and of the owner's jobs; raises if there is no
            capacity.

    Raises:
        IntegrityError: its owner has another job of the same key.
        Exception: raised by ``check``; nothing is inserted.
    """
    if connection.dialect.name == "postgresql":
        # SQLite has one writer at a time. Here two concurrent counts would both find capacity.
        connection.execute(select(func.pg_advisory_xact_lock(_ADD_LOCK)))
    check(*owner_usage(connection, job.owner))
    connection.execute(insert(jobs).values(**dataclasses.asdict(job)))


def find_by_key(connection: Connection, owner: str, key: str) -> Job | None:
    """Find the job of an owner by its idempotency key."""
    query = select(jobs).where(jobs.c.owner == owner, jobs.c.idempotency_key == key)
    row = connection.execute(query).mappings().one_or_none()
    return None if row is None else Job.from_row(row)


def find(connection: Connection, job_id: str, owner: str) -> Job | None:
    """Find a job of an owner."""
    query = select(jobs).where(jobs.c.id == job_id, jobs.c.owner == owner)
    row = connection.execute(query).mappings().one_or_none()
    return None if row is None else Job.from_row(row)


def find_many(connection: Connection, ids: Sequence[str]) -> list[Job]:
    """Find jobs of any owner by their ids."""
    rows = connection.execute(select(jobs).where(jobs.c.id.in_(ids))).mappings()
    return [job for _, job in _readable(rows) if job is not None]


def revisions(connection: Connection, ids: Sequence[str]) -> dict[str, int]:
    """Return the revisions of the existing jobs among some ids, of any owner."""
    rows = connection.execute(select(jobs.c.id, jobs.c.revision).where(jobs.c.id.in_(ids)))
    return {row.id: row.revision for row in rows}


def list_page(
    connection: Connection, owner: str, state: State | None, before: str | None, limit: int
) -> list[tuple[str, Job | None]]:
    """List up to ``limit`` jobs of an owner, newest first, older than the id ``before``.

    Returns:
        Ids and jobs; ``None`` for a row that cannot be read.
    """
    query = select(jobs).where(jobs.c.owner == owner).order_by(jobs.c.id.desc()).limit(limit)
    if state is not None:
        query = query.where(jobs.c.state == state)
    if before is not None:
        query = query.where(jobs.c.id < before)
    return list(_readable(connection.execute(query).mappings()))


def withdraw(
    connection: Connection, job_id: str, owner: str, now: float, expires_at: float
) -> tuple[Job, Job] | None:
    """Cancel an active job, or expire the result of a successful one. Idempotent.

    Returns:
        The job before and after the change, or ``None`` if the owner has no such job.
    """
    query = select(jobs).where(jobs.c.id == job_id, jobs.c.owner == owner).with_for_update()
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        return None
    before = Job.from_row(row)
    if before.state in ACTIVE:
        change = {"state": "cancelled", "finished_at": now, "expires_at": expires_at}
    elif before.state == "succeeded":
        change = {"state": "expired", "expires_at": now}
    else:
        return before, before
    change |= {"revision": before.revision + 1, "runner": None}
    connection.execute(update(jobs).where(jobs.c.id == job_id).values(**change))
    return before, Job.from_row({**row, **change})


def claim(connection: Connection, runner: str, now: float) -> Job | None:
    """Assign the oldest queued job to ``runner`` and return it.

    A row that cannot be read would be the oldest one for ever, so it is ended as failed.
    """
    while True:
        try:
            return _claim(connection, runner, now)
        except UnreadableRowError as error:
            _log.error("row of a job cannot be read; the job failed", reason=str(error))
            change = {
                "state": "failed",
                "runner": None,
                "finished_at": now,
                "expires_at": now,
                "problem": error.problem().members(f"/jobs/{error.job_id}", ""),
            }
            connection.execute(update(jobs).where(jobs.c.id == error.job_id).values(**change))


def _claim(connection: Connection, runner: str, now: float) -> Job | None:
    waiting = (
        select(jobs)
        .where(jobs.c.state == "queued", jobs.c.not_before <= now)
        .order_by(jobs.c.id)
        .limit(1)
        .with_for_update(skip_locked=True)
    )
    row = connection.execute(waiting).mappings().one_or_none()
    if row is None:
        return None
    change = {
        "state": "running",
        "stage": "prepare",
        "runner": runner,
        "attempts": _next(row, "attempts"),
        "revision": _next(row, "revision"),
        "started_at": now,
        "patches_done": 0,
        "patches_total": None,
    }
    job = Job.from_row({**row, **change})
    connection.execute(update(jobs).where(jobs.c.id == job.id).values(**change))
    return job


def update_progress(
    connection: Connection, job_id: str, runner: str, stage: str, done: int, total: int | None
) -> bool:
    """Store the progress of a job; return False if it no longer belongs to ``runner``."""
    change = {"stage": stage, "patches_done": done, "patches_total": total}
    return _change(connection, job_id, runner, change)


def succeed(
    connection: Connection,
    job_id: str,
    runner: str,
    success: Success,
    now: float,
    expires_at: float,
) -> bool:
    """End a job whose result is on disk; return False if it no longer belongs to ``runner``."""
    change = {
        "state": "succeeded",
        "stage": "done",
        "runner": None,
        "finished_at": now,
        "expires_at": expires_at,
        "result_bytes": success.size,
        "result_sha256": success.sha256,
        "report": success.report,
        "timings": success.timings,
        "model": success.model,
        "patches_done": success.patches,
        "patches_total": success.patches,
    }
    return _change(connection, job_id, runner, change)


def fail(
    connection: Connection,
    job_id: str,
    runner: str,
    problem: Mapping[str, Any],
    now: float,
    expires_at: float,
) -> bool:
    """End a job with a problem; return False if it no longer belongs to ``runner``."""
    change = {
        "state": "failed",
        "runner": None,
        "finished_at": now,
        "expires_at": expires_at,
        "problem": dict(problem),
    }
    return _change(connection, job_id, runner, change)


def requeue(
    connection: Connection, job_id: str, runner: str, attempts: int, not_before: float
) -> bool:
    """Queue a running job again; return False if it no longer belongs to ``runner``.

    Args:
        connection: of a writing transaction.
        job_id: id of the job.
        runner: name of the process that runs it.
        attempts: new number of attempts.
        not_before: earliest start, seconds since 1970.
    """
    change = {**_QUEUED, "attempts": attempts, "not_before": not_before}
    return _change(connection, job_id, runner, change)


def runners(connection: Connection) -> list[str]:
    """Return the names of all processes with running jobs, including ended processes."""
    query = select(jobs.c.runner).where(jobs.c.state == "running").distinct()
    return [name or "" for name in connection.execute(query).scalars()]


def requeue_all_of(connection: Connection, ended: Iterable[str], max_attempts: int) -> list[Job]:
    """Queue the jobs of ended processes again; return those with too many attempts.

    The returned jobs are not changed; the caller ends them as failed.
    """
    names = list(ended)
    mine = (jobs.c.state == "running", jobs.c.runner.in_(names))
    change = {**_QUEUED, "revision": jobs.c.revision + 1}
    repeatable = jobs.c.attempts < max_attempts
    connection.execute(update(jobs).where(*mine, repeatable).values(**change))
    rows = connection.execute(select(jobs).where(*mine)).mappings()
    return [job for _, job in _readable(rows) if job is not None]


def requeue_unknown(
    connection: Connection, runner: str, known: Iterable[str], before: float
) -> int:
    """Queue jobs again that ``runner`` started before a time but does not know; count them."""
    unknown = (
        jobs.c.state == "running",
        jobs.c.runner == runner,
        jobs.c.started_at < before,
        jobs.c.id.not_in(list(known)),
    )
    change = {**_QUEUED, "revision": jobs.c.revision + 1}
    return connection.execute(update(jobs).where(*unknown).values(**change)).rowcount


def expire(connection: Connection, now: float) -> list[str]:
    """Expire results whose time is over; return the ids of their jobs."""
    over = (jobs.c.state == "succeeded", jobs.c.expires_at <= now)
    change = {"state": "expired", "revision": jobs.c.revision + 1}
    # Not by ids, which may be more than a statement may have parameters.
    query = update(jobs).where(*over).values(**change).returning(jobs.c.id)
    return list(connection.execute(query).scalars())


def prune(connection: Connection, before: float) -> int:
    """Delete the rows of finished jobs whose results expired before a time; return the number."""
    old = delete(jobs).where(jobs.c.state.in_(FINAL), jobs.c.expires_at <= before)
    return connection.execute(old).rowcount


def prune_most(connection: Connection, kept: int) -> int:
    """Delete the oldest finished jobs without a result, apart from ``kept`` of each owner.

    Jobs that fail at once would otherwise fill the table faster than `prune` empties it.
    """
    without = jobs.c.state.in_(("failed", "cancelled", "expired"))
    many = select(jobs.c.owner).where(without).group_by(jobs.c.owner).having(func.count() > kept)
    removed = 0
    for owner in connection.execute(many).scalars().all():
        mine = (without, jobs.c.owner == owner)
        newest = select(jobs.c.id).where(*mine).order_by(jobs.c.id.desc()).offset(kept).limit(1)
        last = connection.execute(newest).scalar()
        removed += connection.execute(delete(jobs).where(*mine, jobs.c.id <= last)).rowcount
    return removed


def wanted_files(connection: Connection) -> tuple[set[str], set[str]]:
    """Return the ids of jobs whose inputs are needed, and of those whose results are."""
    rows = connection.execute(
        select(jobs.c.id, jobs.c.state).where(jobs.c.state.in_((*ACTIVE, "succeeded")))
    ).all()
    inputs = {job_id for job_id, state in rows if state in ACTIVE}
    # The result of a running job is stored just before its row is updated.
    results = {job_id for job_id, state in rows if state in {"running", "succeeded"}}
    return inputs, results


_QUEUED: dict[str, Any] = {
    "state": "queued",
    "stage": "queued",
    "runner": None,
    "patches_done": 0,
    "patches_total": None,
}


def _readable(rows: Iterable[Mapping[Any, Any]]) -> Iterator[tuple[str, Job | None]]:
    """Yield the ids and jobs of rows; ``None`` instead of a job that cannot be read."""
    for row in rows:
        try:
            yield row["id"], Job.from_row(row)
        except UnreadableRowError as error:
            _log.error("row of a job cannot be read", reason=str(error))
            yield row["id"], None


def _next(row: Mapping[Any, Any], column: str) -> int:
    if not isinstance(row[column], int):
        raise UnreadableRowError(row["id"], [column])
    return int(row[column]) + 1


def _change(connection: Connection, job_id: str, runner: str, change: dict[str, Any]) -> bool:
    mine = (jobs.c.id == job_id, jobs.c.runner == runner, jobs.c.state == "running")
    values = {**change, "revision": jobs.c.revision + 1}
    return connection.execute(update(jobs).where(*mine).values(**values)).rowcount == 1
