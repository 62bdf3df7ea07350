# SPDX-License-Identifier: Apache-2.0
"""What clients ask of the jobs' table; each function is one transaction."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select, update

from pugeo_service.jobs.models import ACTIVE, Job, State
from pugeo_service.jobs.schema import jobs

__all__ = ["Usage", "add", "by_key", "get", "many", "page", "usage", "usages", "withdraw"]


_ADDING = 0x70756765  # any number that nobody else locks in this database


@dataclass(frozen=True)
class Usage:
    """What jobs take up, all together or those of one owner.

    Attributes:
        queued: jobs that wait.
        running: jobs that run.
        bytes: of inputs of these, and of results that are kept.
    """

    queued: int = 0
    running: int = 0
    bytes: int = 0

    @property
    def active(self) -> int:
        """Jobs that wait or run."""
        return self.queued + self.running


def usage(connection: Connection, owner: str | None = None) -> Usage:
    """Add up what is taken, by everybody or by one owner."""
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
    return Usage(queued[0], running[0], queued[1] + running[1] + kept)


def usages(connection: Connection, owner: str) -> tuple[Usage, Usage]:
    """Add up what everybody takes, and what one owner does; ``""`` is everybody."""
    taken = usage(connection)
    return taken, usage(connection, owner) if owner else taken


def add(connection: Connection, job: Job, check: Callable[[Usage, Usage], None]) -> None:
    """Insert a new job where there is room for it.

    Args:
        connection: in a transaction that writes.
        job: the new one.
        check: given what everybody takes and what the job's owner does, raises if that is too
            much.

    Raises:
        IntegrityError: its owner has another job of that key.
        Exception: what ``check`` raises; nothing is inserted then.
    """
    if connection.dialect.name == "postgresql":
        # SQLite has one writer at a time; here two that count at once would both find room.
        connection.execute(select(func.pg_advisory_xact_lock(_ADDING)))
    check(*usages(connection, job.owner))
    connection.execute(insert(jobs).values(**dataclasses.asdict(job)))


def by_key(connection: Connection, owner: str, key: str) -> Job | None:
    """Find the job that an owner already has under a key."""
    query = select(jobs).where(jobs.c.owner == owner, jobs.c.idempotency_key == key)
    row = connection.execute(query).mappings().one_or_none()
    return None if row is None else Job.from_row(row)


def get(connection: Connection, job_id: str, owner: str) -> Job | None:
    """Find a job of an owner."""
    query = select(jobs).where(jobs.c.id == job_id, jobs.c.owner == owner)
    row = connection.execute(query).mappings().one_or_none()
    return None if row is None else Job.from_row(row)


def many(connection: Connection, ids: Sequence[str]) -> list[Job]:
    """Find jobs by their ids, whoever's they are."""
    rows = connection.execute(select(jobs).where(jobs.c.id.in_(ids))).mappings()
    return [Job.from_row(row) for row in rows]


def page(
    connection: Connection, owner: str, state: State | None, before: str | None, limit: int
) -> list[Job]:
    """List up to ``limit`` jobs of an owner, newest first, older than the id ``before``."""
    query = select(jobs).where(jobs.c.owner == owner).order_by(jobs.c.id.desc()).limit(limit)
    if state is not None:
        query = query.where(jobs.c.state == state)
    if before is not None:
        query = query.where(jobs.c.id < before)
    return [Job.from_row(row) for row in connection.execute(query).mappings()]


def withdraw(
    connection: Connection, job_id: str, owner: str, now: float, expires_at: float
) -> tuple[Job, Job] | None:
    """Cancel a job, or give up its result; nothing changes where that has happened already.

    Returns:
        The job as it was and as it is, or ``None`` where the owner has no such job.
    """
    query = select(jobs).where(jobs.c.id == job_id, jobs.c.owner == owner).with_for_update()
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        return None
    was = Job.from_row(row)
    if was.state in ACTIVE:
        change = {"state": "cancelled", "finished_at": now, "expires_at": expires_at}
    elif was.state == "succeeded":
        change = {"state": "expired", "expires_at": now}
    else:
        return was, was
    change |= {"revision": was.revision + 1, "runner": None}
    connection.execute(update(jobs).where(jobs.c.id == job_id).values(**change))
    return was, Job.from_row({**row, **change})
