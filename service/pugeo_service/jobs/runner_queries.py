# SPDX-License-Identifier: Apache-2.0
"""What runs the jobs asks of their table; each function is one transaction.

A job belongs to the process whose name stands in ``runner``. Every change to a running job asks
for that name and for the state ``running``, so a job that was cancelled, or that somebody else
took over, is never touched by whoever had it before.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import Connection, delete, select, update

from pugeo_service.jobs.models import ACTIVE, FINAL, Job, Success
from pugeo_service.jobs.schema import jobs

__all__ = [
    "claim", "expire", "fail", "give_back", "progress", "prune", "put_back", "release", "runners",
    "succeed", "wanted",
]  # fmt: skip


def claim(connection: Connection, runner: str, now: float) -> Job | None:
    """Take the job that has waited longest and make it ``runner``'s."""
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
        "attempts": row["attempts"] + 1,
        "revision": row["revision"] + 1,
        "started_at": now,
        "patches_done": 0,
        "patches_total": None,
    }
    connection.execute(update(jobs).where(jobs.c.id == row["id"]).values(**change))
    return Job.from_row({**row, **change})


def progress(
    connection: Connection, job_id: str, runner: str, stage: str, done: int, total: int | None
) -> bool:
    """Note how far a job is; return whether it is still ``runner``'s."""
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
    """End a job whose result is on disk; return whether it was still ``runner``'s."""
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
    """End a job with a problem; return whether it was still ``runner``'s."""
    change = {
        "state": "failed",
        "runner": None,
        "finished_at": now,
        "expires_at": expires_at,
        "problem": dict(problem),
    }
    return _change(connection, job_id, runner, change)


def give_back(
    connection: Connection, job_id: str, runner: str, attempts: int, not_before: float
) -> bool:
    """Put a job back into the queue; return whether it was still ``runner``'s.

    Args:
        attempts: what to count it as having been begun.
        not_before: when it may be begun again.
    """
    change = {**_QUEUED, "attempts": attempts, "not_before": not_before}
    return _change(connection, job_id, runner, change)


def runners(connection: Connection) -> list[str]:
    """Name the processes that run jobs, dead or alive."""
    query = select(jobs.c.runner).where(jobs.c.state == "running").distinct()
    return [name or "" for name in connection.execute(query).scalars()]


def release(connection: Connection, dead: Iterable[str], most_attempts: int) -> list[Job]:
    """Put the jobs of dead processes back; return those that were begun too often for that.

    The latter stay as they are, for the caller to take over and fail.
    """
    names = list(dead)
    mine = (jobs.c.state == "running", jobs.c.runner.in_(names))
    change = {**_QUEUED, "revision": jobs.c.revision + 1}
    spared = jobs.c.attempts < most_attempts
    connection.execute(update(jobs).where(*mine, spared).values(**change))
    rows = connection.execute(select(jobs).where(*mine)).mappings()
    return [Job.from_row(row) for row in rows]


def put_back(connection: Connection, runner: str, known: Iterable[str], before: float) -> int:
    """Put back what ``runner`` began before a time and does not know of; return how many."""
    stray = (
        jobs.c.state == "running",
        jobs.c.runner == runner,
        jobs.c.started_at < before,
        jobs.c.id.not_in(list(known)),
    )
    change = {**_QUEUED, "revision": jobs.c.revision + 1}
    return connection.execute(update(jobs).where(*stray).values(**change)).rowcount


def expire(connection: Connection, now: float) -> list[str]:
    """Mark results whose time is over; return the ids of their jobs."""
    over = (jobs.c.state == "succeeded", jobs.c.expires_at <= now)
    change = {"state": "expired", "revision": jobs.c.revision + 1}
    # Not by their ids: there may be more of them than a statement may have parameters.
    query = update(jobs).where(*over).values(**change).returning(jobs.c.id)
    return list(connection.execute(query).scalars())


def prune(connection: Connection, before: float) -> int:
    """Forget finished jobs whose results were over before a time; return how many."""
    old = delete(jobs).where(jobs.c.state.in_(FINAL), jobs.c.expires_at <= before)
    return connection.execute(old).rowcount


def wanted(connection: Connection) -> tuple[set[str], set[str]]:
    """Return the ids of the jobs whose inputs, and of those whose results, are to be kept."""
    rows = connection.execute(
        select(jobs.c.id, jobs.c.state).where(jobs.c.state.in_((*ACTIVE, "succeeded")))
    ).all()
    inputs = {job_id for job_id, state in rows if state in ACTIVE}
    # A running job may have its result in place a moment before its row says so.
    results = {job_id for job_id, state in rows if state in {"running", "succeeded"}}
    return inputs, results


_QUEUED: dict[str, Any] = {
    "state": "queued",
    "stage": "queued",
    "runner": None,
    "patches_done": 0,
    "patches_total": None,
}


def _change(connection: Connection, job_id: str, runner: str, change: dict[str, Any]) -> bool:
    mine = (jobs.c.id == job_id, jobs.c.runner == runner, jobs.c.state == "running")
    values = {**change, "revision": jobs.c.revision + 1}
    return connection.execute(update(jobs).where(*mine).values(**values)).rowcount == 1
