# SPDX-License-Identifier: Apache-2.0
"""Feed of changed jobs: one database query serves all subscribers together."""

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterator

from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["ChangeFeed"]

# Interval in which changes by other processes are noticed; changes by this one are noticed at once.
_POLL_S = 0.5
_MAX_SUBSCRIBERS = 1000


class ChangeFeed:
    """Sends the present state of jobs to subscribers.

    Changes are read from the database, because another process may run the job.

    Args:
        fetch: returns the existing jobs among some ids.
    """

    def __init__(self, fetch: Callable[[list[str]], Awaitable[list[Job]]]) -> None:
        self._fetch = fetch
        self._subscribers: defaultdict[str, set[asyncio.Queue[Job | None]]] = defaultdict(set)
        self._wake = asyncio.Event()
        self._closed = False

    def notify(self) -> None:
        """Query the database now, because a job has changed."""
        self._wake.set()

    def close(self) -> None:
        """End all present and future subscriptions."""
        self._closed = True
        for queues in self._subscribers.values():
            for queue in queues:
                _put(queue, None)

    def check_capacity(self) -> None:
        """Refuse another subscriber if there are too many or the feed is closed.

        Raises:
            ProblemError: 503.
        """
        if self._closed:
            detail = "The service is shutting down; connect again after its restart."
            raise ProblemError(503, "draining", detail, retry_after=5)
        if sum(map(len, self._subscribers.values())) >= _MAX_SUBSCRIBERS:
            detail = "Too many clients watch jobs; poll the job itself instead."
            raise ProblemError(503, "too_many_watchers", detail, retry_after=5)

    @contextlib.contextmanager
    def subscribe(self, job_id: str) -> Iterator["asyncio.Queue[Job | None]"]:
        """Subscribe to a job: the queue holds its latest state, or ``None`` at the end."""
        queue: asyncio.Queue[Job | None] = asyncio.Queue(1)
        if self._closed:
            _put(queue, None)
        self._subscribers[job_id].add(queue)
        self._wake.set()
        try:
            yield queue
        finally:
            self._subscribers[job_id].discard(queue)
            if not self._subscribers[job_id]:
                del self._subscribers[job_id]

    async def run(self) -> None:
        """Send changes until cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_S if self._subscribers else None):
                    await self._wake.wait()
            self._wake.clear()
            ids = list(self._subscribers)
            if not ids:
                continue
            try:
                found = {job.id: job for job in await self._fetch(ids)}
            except ProblemError:
                # Logged by the database; subscribers are updated once it is available again.
                await asyncio.sleep(_POLL_S)
                continue
            for job_id in ids:
                for queue in self._subscribers.get(job_id, ()):
                    # The feed may have been closed during the query.
                    _put(queue, None if self._closed else found.get(job_id))


def _put(queue: "asyncio.Queue[Job | None]", value: Job | None) -> None:
    """Put a value; replace an older one that was not taken yet."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(value)
