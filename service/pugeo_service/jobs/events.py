# SPDX-License-Identifier: Apache-2.0
"""Server-sent events of a job."""

import asyncio
from collections.abc import AsyncIterator

from fastapi.sse import format_sse_event

from pugeo_service.jobs.api_models import JobProgress, JobResponse
from pugeo_service.jobs.models import Job

__all__ = ["stream"]

_HEARTBEAT_S = 15.0
_RECONNECT_MS = 2000
_MAX_DIGITS = 10


async def stream(
    job: Job,
    changes: "asyncio.Queue[Job | None]",
    last_event_id: str | None,
    heartbeat_s: float = _HEARTBEAT_S,
) -> AsyncIterator[bytes]:
    """Yield the events of a job until its end, or until ``changes`` yields ``None``.

    ``state`` and ``end`` contain the whole job, ``progress`` its progress. Event ids are revisions
    of the job, so that a client that reconnects receives no event twice.

    Args:
        job: present state.
        changes: later states.
        last_event_id: header of a client that reconnects; ignored if it is not a revision of this
            job.
        heartbeat_s: seconds without an event before a comment is sent, because proxies close
            silent connections.
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
    data = JobProgress.from_job(job) if kind == "progress" else JobResponse.from_job(job)
    return format_sse_event(data_str=data.model_dump_json(), event=kind, id=str(job.revision))


def _revision(last_event_id: str | None, job: Job) -> int | None:
    text = last_event_id or ""
    if not (text.isascii() and text.isdigit() and len(text) < _MAX_DIGITS):
        return None
    return int(text) if int(text) <= job.revision else None
