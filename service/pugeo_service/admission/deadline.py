# SPDX-License-Identifier: Apache-2.0
"""When a request must be done: the service's own limit, and how long its client waits."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from pugeo_service.http.cancellation import DeadlinePassedError
from pugeo_service.http.prefer import Preferences

__all__ = ["Deadline"]


class Deadline:
    """The time of one request.

    The client's time runs from the head of its request, as its own clock does; the service's
    limit bounds the work alone, so that a slow line does not eat it up.

    Args:
        wanted: what the client prefers; ``Prefer: wait=30`` without ``respond-async`` gives it 30
            seconds, after which RFC 7240 has the server answer 504.
        limit: seconds that the service allows for the work.
        clock: seconds, from anywhere.
    """

    def __init__(
        self, wanted: Preferences, limit: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._limit = limit
        self.wait = None if wanted.respond_async else wanted.wait
        self._leaves = float("inf") if self.wait is None else clock() + self.wait
        self._ends = float("inf")

    @asynccontextmanager
    async def arriving(self) -> AsyncIterator[None]:
        """Bound the time in which the body arrives; the work's own begins at the end of it.

        Raises:
            DeadlinePassedError: the client stopped waiting.
        """
        try:
            async with asyncio.timeout(None if self.wait is None else self.left):
                yield
        except TimeoutError as error:
            raise DeadlinePassedError from error
        self._ends = self._clock() + self._limit

    @property
    def left(self) -> float:
        """Seconds until the client stops waiting or the service gives up; 0 at least."""
        return max(0.0, min(self._leaves, self._ends) - self._clock())

    @property
    def shown(self) -> str:
        """Whose limit it is, and which, for a sentence."""
        if self._leaves < self._ends:
            return f"{self.wait:g} s, which Prefer: wait asked for"
        return f"{self._limit:g} s, the limit of this service"

    @property
    def seconds(self) -> float:
        """The limit that counts."""
        return float(self.wait) if self.wait and self._leaves < self._ends else self._limit
