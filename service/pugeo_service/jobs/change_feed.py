# SPDX-License-Identifier: Apache-2.0
"""Who watches which job: one question to the database for all of them together."""

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterator

from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["Watch"]

# Changes made by another process are seen after so long; those of this one at once.
_POLL_S = 0.5
_MOST_WATCHERS = 1000


class Watch:
    """Tells watchers what jobs look like now.

    The database is asked, and not the code that changes it, so that a job may run in another
    process than the one that is asked about it.

    Args:
        fetch: returns jobs by their ids, those that there are.
    """

    def __init__(self, fetch: Callable[[list[str]], Awaitable[list[Job]]]) -> None:
        self._fetch = fetch
        self._watchers: defaultdict[str, set[asyncio.Queue[Job | None]]] = defaultdict(set)
        self._wake = asyncio.Event()
        self._closed = False

    def changed(self) -> None:
        """Look now instead of soon: some job has changed."""
        self._wake.set()

    def close(self) -> None:
        """End all watching, now and from now on."""
        self._closed = True
        for queues in self._watchers.values():
            for queue in queues:
                _put(queue, None)

    def check(self) -> None:
        """Refuse another watcher where there are too many, or nobody may watch any more.

        Raises:
            ProblemError: 503.
        """
        if self._closed:
            detail = "The service is shutting down; it tells of the job again when it is back."
            raise ProblemError(503, "draining", detail, retry_after=5)
        if sum(map(len, self._watchers.values())) >= _MOST_WATCHERS:
            detail = "Too many clients watch jobs; ask for the job itself from time to time."
            raise ProblemError(503, "too_many_watchers", detail, retry_after=5)

    @contextlib.contextmanager
    def following(self, job_id: str) -> Iterator["asyncio.Queue[Job | None]"]:
        """Follow a job: the queue has its latest state, or ``None`` at the end of watching."""
        queue: asyncio.Queue[Job | None] = asyncio.Queue(1)
        if self._closed:
            _put(queue, None)
        self._watchers[job_id].add(queue)
        self._wake.set()
        try:
            yield queue
        finally:
            self._watchers[job_id].discard(queue)
            if not self._watchers[job_id]:
                del self._watchers[job_id]

    async def run(self) -> None:
        """Keep looking; ends when it is cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_S if self._watchers else None):
                    await self._wake.wait()
            self._wake.clear()
            ids = list(self._watchers)
            if not ids:
                continue
            try:
                found = {job.id: job for job in await self._fetch(ids)}
            except ProblemError:
                # The log has it; watchers get their heartbeats, and the truth when it is back.
                await asyncio.sleep(_POLL_S)
                continue
            for job_id in ids:
                for queue in self._watchers.get(job_id, ()):
                    # Asked before the end, answered after it: the end stands.
                    _put(queue, None if self._closed else found.get(job_id))


def _put(queue: "asyncio.Queue[Job | None]", value: Job | None) -> None:
    """Replace what nobody has taken yet: only the latest counts."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(value)
