# SPDX-License-Identifier: Apache-2.0
"""Feed of changed jobs: one database query serves all subscribers together."""

import asyncio
import contextlib
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field

from pugeo_service.admission.fair_share import check_share
from pugeo_service.jobs.models import Job
from pugeo_service.problems import ProblemError

__all__ = ["ChangeFeed"]

# Interval in which changes by other processes are noticed; changes by this one are noticed at once.
_POLL_S = 0.5
_MAX_SUBSCRIBERS = 1000
_RETRY_S = 5.0


@dataclass(eq=False)
class _Subscription:
    """One subscriber.

    Attributes:
        owner: name of its API key.
        is_valid: whether that key is still valid.
        revision: of the last state that was sent.
        queue: the latest state, or ``None`` at the end.
    """

    owner: str
    is_valid: Callable[[], bool]
    revision: int
    queue: "asyncio.Queue[Job | None]" = field(default_factory=lambda: asyncio.Queue(1))

    def put(self, job: Job | None) -> None:
        """Send a state; it replaces an older one that was not taken yet."""
        if job is not None:
            self.revision = job.revision
        if self.queue.full():
            self.queue.get_nowait()
        self.queue.put_nowait(job)


class ChangeFeed:
    """Sends the present state of jobs to subscribers.

    Changes are read from the database, because another process may run the job. The work grows
    with the number of subscribers and not faster: a query brings the revisions of their jobs, and a
    second one the jobs among them that have changed.

    Args:
        revisions: returns the revisions of the existing jobs among some ids.
        fetch: returns the existing jobs among some ids.
        keys_version: returns another value after API keys have changed.
    """

    def __init__(
        self,
        revisions: Callable[[list[str]], Awaitable[Mapping[str, int]]],
        fetch: Callable[[list[str]], Awaitable[list[Job]]],
        keys_version: Callable[[], object] = lambda: None,
    ) -> None:
        self._revisions = revisions
        self._fetch = fetch
        self._keys_version = keys_version
        self._checked_version: object = None
        self._subscribers: defaultdict[str, set[_Subscription]] = defaultdict(set)
        self._by_owner: Counter[str] = Counter()
        self._wake = asyncio.Event()
        self._closed = False

    def notify(self) -> None:
        """Query the database now, because a job has changed."""
        self._wake.set()

    def close(self) -> None:
        """End all present and future subscriptions."""
        self._closed = True
        for subscription in self._all():
            subscription.put(None)

    @contextlib.contextmanager
    def subscribe(
        self,
        job_id: str,
        revision: int = 0,
        owner: str = "",
        is_valid: Callable[[], bool] = lambda: True,
    ) -> Iterator["asyncio.Queue[Job | None]"]:
        """Subscribe to a job: the queue holds its latest state, or ``None`` at the end.

        Args:
            job_id: id of the job.
            revision: of the state that the subscriber has; only others are sent.
            owner: name of the API key; ``""`` without keys, where no shares apply.
            is_valid: whether the key of the subscriber is still valid; asked after keys changed.

        Raises:
            ProblemError: 503 if there are too many subscribers or the feed is closed, 429 if the
                owner has its share of them.
        """
        self._check_capacity(owner)
        subscription = _Subscription(owner, is_valid, revision)
        if not self._subscribers:
            self._wake.set()
        self._subscribers[job_id].add(subscription)
        self._by_owner[owner] += 1
        try:
            yield subscription.queue
        finally:
            self._by_owner -= Counter((owner,))
            self._subscribers[job_id].discard(subscription)
            if not self._subscribers[job_id]:
                del self._subscribers[job_id]

    async def run(self) -> None:
        """Send changes until cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_POLL_S if self._subscribers else None):
                    await self._wake.wait()
            self._wake.clear()
            self._end_revoked()
            try:
                await self._send_changes()
            except ProblemError:
                # Logged by the database; subscribers are updated once it is available again.
                await asyncio.sleep(_POLL_S)

    def _all(self) -> list[_Subscription]:
        return [each for group in self._subscribers.values() for each in group]

    def _check_capacity(self, owner: str) -> None:
        if self._closed:
            detail = "The service is shutting down; connect again after its restart."
            raise ProblemError(503, "draining", detail, retry_after=_RETRY_S)
        total = self._by_owner.total()
        if total >= _MAX_SUBSCRIBERS:
            detail = "Too many clients watch jobs; poll the job itself instead."
            raise ProblemError(503, "too_many_watchers", detail, retry_after=_RETRY_S)
        if owner:
            check_share(
                "streams",
                "the event streams",
                None,
                held=self._by_owner[owner],
                held_elsewhere=self._by_owner[owner],
                wanted=1,
                free=_MAX_SUBSCRIBERS - total,
                retry_after=lambda _: _RETRY_S,
            )

    def _end_revoked(self) -> None:
        """End the subscriptions whose key is no longer valid."""
        version = self._keys_version()
        if version == self._checked_version:
            return
        self._checked_version = version
        for subscription in self._all():
            if not subscription.is_valid():
                subscription.put(None)

    async def _send_changes(self) -> None:
        ids = list(self._subscribers)
        if not ids:
            return
        known = await self._revisions(ids)
        changed = [
            job_id
            for job_id in ids
            if job_id in known
            and any(known[job_id] != each.revision for each in self._subscribers.get(job_id, ()))
        ]
        found = {job.id: job for job in await self._fetch(changed)} if changed else {}
        # The feed may have been closed during the queries; its end must not be replaced.
        if self._closed:
            return
        for job_id in ids:
            for subscription in self._subscribers.get(job_id, ()):
                if job_id not in known:
                    subscription.put(None)
                elif job_id in found and found[job_id].revision != subscription.revision:
                    subscription.put(found[job_id])
