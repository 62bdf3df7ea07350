# SPDX-License-Identifier: Apache-2.0
"""Deadline of a request: the limit of the service and the waiting time of the client."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

__all__ = ["Deadline", "DeadlinePassedError"]


class DeadlinePassedError(Exception):
    """The deadline of a request has passed."""


class Deadline:
    """Deadline of one request.

    The client's time starts with the head of its request, as the client's own clock does. The limit
    of the service starts when the body has arrived, so that a slow connection does not use it up.

    Args:
        wait: seconds that the client waits for the answer (``Prefer: wait`` of RFC 7240), or
            ``None`` for no limit.
        limit: seconds that the service allows for the work.
        clock: monotonic time in seconds.
    """

    def __init__(
        self, wait: int | None, limit: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._limit = limit
        self.wait = wait
        self._client_end = float("inf") if wait is None else clock() + wait
        self._service_end = float("inf")

    @asynccontextmanager
    async def receiving_body(self) -> AsyncIterator[None]:
        """Bound the time in which the body arrives; the limit of the service starts at the end.

        Raises:
            DeadlinePassedError: the client no longer waits.
        """
        try:
            async with asyncio.timeout(None if self.wait is None else self.remaining):
                yield
        except TimeoutError as error:
            raise DeadlinePassedError from error
        self._service_end = self._clock() + self._limit

    @property
    def remaining(self) -> float:
        """Seconds until the earlier of both ends, >= 0."""
        return max(0.0, min(self._client_end, self._service_end) - self._clock())

    @property
    def seconds(self) -> float:
        """Length of the limit that ends first, in seconds."""
        if self.wait is None or self._service_end <= self._client_end:
            return self._limit
        return float(self.wait)

    @property
    def setting(self) -> str | None:
        """Name of the setting of the limit that ends first; ``None`` if it is the client's time."""
        return None if self._client_end < self._service_end else "PUGEO_DEADLINE_S"

    @property
    def description(self) -> str:
        """The limit that ends first, for an error text."""
        if self._client_end < self._service_end:
            return f"{self.wait:g} s, which Prefer: wait asked for"
        return f"{self._limit:g} s, the limit of this service"
