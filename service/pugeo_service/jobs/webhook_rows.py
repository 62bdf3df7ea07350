# SPDX-License-Identifier: Apache-2.0
"""The table of webhooks that are still to be sent, and its queries; each within one transaction.

A row is made with its job and removed once the webhook arrived, or was given up. A process that
sends one moves its time forward first, so that no other process sends it meanwhile; if it ends, the
row is due again.
"""

from dataclasses import dataclass

from sqlalchemy import (
    Column,
    Connection,
    Double,
    Integer,
    String,
    Table,
    delete,
    insert,
    select,
    update,
)

from pugeo_service.jobs.models import FINAL, jobs, metadata

__all__ = ["Due", "add", "claim", "postpone", "remove", "remove_orphans"]

webhooks = Table(
    "pugeo_webhooks",
    metadata,
    Column("job_id", String(32), primary_key=True),
    Column("url", String(2048), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("not_before", Double, nullable=False),
)


@dataclass(frozen=True)
class Due:
    """A webhook that is to be sent now.

    Attributes:
        job_id: the job that has ended.
        url: the address.
        attempts: number of attempts that failed.
    """

    job_id: str
    url: str
    attempts: int


def add(connection: Connection, job_id: str, url: str) -> None:
    """Add the webhook of a new job."""
    row = {"job_id": job_id, "url": url, "attempts": 0, "not_before": 0.0}
    connection.execute(insert(webhooks).values(**row))


def claim(connection: Connection, now: float, until: float, limit: int) -> list[Due]:
    """Take up to ``limit`` webhooks of jobs that have ended, for this process, until a time."""
    query = (
        select(webhooks)
        .join(jobs, jobs.c.id == webhooks.c.job_id)
        .where(jobs.c.state.in_(FINAL), webhooks.c.not_before <= now)
        .order_by(webhooks.c.not_before)
        .limit(limit)
    )
    claimed = []
    for row in connection.execute(query).all():
        take = (
            update(webhooks)
            .where(webhooks.c.job_id == row.job_id, webhooks.c.not_before == row.not_before)
            .values(not_before=until)
        )
        if connection.execute(take).rowcount:
            claimed.append(Due(row.job_id, row.url, row.attempts))
    return claimed


def postpone(connection: Connection, job_id: str, attempts: int, not_before: float) -> None:
    """Store a failed attempt and the time of the next one."""
    connection.execute(
        update(webhooks)
        .where(webhooks.c.job_id == job_id)
        .values(attempts=attempts, not_before=not_before)
    )


def remove(connection: Connection, job_id: str) -> None:
    """Remove a webhook."""
    connection.execute(delete(webhooks).where(webhooks.c.job_id == job_id))


def remove_orphans(connection: Connection) -> None:
    """Remove the webhooks of jobs whose rows are gone."""
    connection.execute(delete(webhooks).where(webhooks.c.job_id.not_in(select(jobs.c.id))))
