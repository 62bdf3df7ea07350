# SPDX-License-Identifier: Apache-2.0
"""A job as a stream of server-sent events."""

import asyncio
from collections.abc import AsyncIterator

from fastapi.sse import format_sse_event

from pugeo_service.jobs.api_models import JobView, ProgressView
from pugeo_service.jobs.models import Job

__all__ = ["stream"]

_HEARTBEAT_S = 15.0
_RECONNECT_MS = 2000


async def stream(
    job: Job,
    changes: "asyncio.Queue[Job | None]",
    last_event_id: str | None,
    heartbeat_s: float = _HEARTBEAT_S,
) -> AsyncIterator[bytes]:
    """Yield the events of a job until its end, or until ``changes`` yields ``None``.

    ``state`` and ``end`` carry the whole job, ``progress`` its progress; ids are revisions of the
    job, so that a client that comes back gets what it has not seen, and nothing twice.

    Args:
        job: as it is now.
        changes: its later states.
        last_event_id: what a client that comes back has seen; anything that is no revision of
            this job counts as nothing.
        heartbeat_s: seconds of silence before a comment is sent, lest proxies close the line.
    """
    yield format_sse_event(retry=_RECONNECT_MS)
    if _revision(last_event_id, job) != job.revision:
        yield _event("state", job)
    while not job.finished:
        try:
            async with asyncio.timeout(heartbeat_s):
                latest = await changes.get()
        except TimeoutError:
            yield format_sse_event(comment="")
            continue
        if latest is None:
            return
        if latest.revision > job.revision:
            kind = "state" if latest.state != job.state else "progress"
            job = latest
            yield _event(kind, job)
    yield _event("end", job)


def _event(kind: str, job: Job) -> bytes:
    shown = ProgressView.of(job) if kind == "progress" else JobView.of(job)
    return format_sse_event(data_str=shown.model_dump_json(), event=kind, id=str(job.revision))


def _revision(last_event_id: str | None, job: Job) -> int | None:
    known = last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit()
    seen = int(last_event_id) if known and last_event_id and len(last_event_id) < 10 else None
    return seen if seen is not None and seen <= job.revision else None
