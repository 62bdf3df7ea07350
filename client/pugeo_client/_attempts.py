# SPDX-License-Identifier: Apache-2.0
"""The tries of one call: its deadline, its retries, its progress."""

import math
import random
import time
from collections.abc import Callable, Mapping
from typing import TypeAlias

from pugeo_client import _retry
from pugeo_client._http import httpx
from pugeo_client._wire import Request
from pugeo_client.errors import ConnectionFailedError, DeadlineExceededError, PugeoError

__all__ = ["Attempts", "Progress"]

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with a stage (``"send"``, ``"receive"``), bytes done and bytes in all (0: unknown)."""

LONGEST_CONNECT = 10.0  # seconds: a host that drops packets should cost a retry, not the call
MOST_EXACT_WAIT = 1e-3  # an HTTP library refuses a timeout of 0
LONGEST_WAIT = 1e6  # seconds; infinity is no number that a header takes


class Attempts:
    """Watches one call, from its first try to the end of its last.

    Args:
        request: what is sent at each try.
        timeout: seconds for all tries and the waits between them.
        max_retries: tries after failures; a service that is full is no failure.
        on_progress: told of every chunk, or None.
    """

    def __init__(
        self,
        request: Request,
        *,
        timeout: float,
        max_retries: int,
        on_progress: Progress | None = None,
    ) -> None:
        self.request = request
        self._on_progress = on_progress
        self._timeout = timeout
        self._end = time.monotonic() + timeout
        self._max_retries = max_retries
        self._made = 0
        self._failed = 0

    @property
    def remaining(self) -> float:
        """Seconds left; negative after the end."""
        return self._end - time.monotonic()

    def check(self) -> None:
        """Raise DeadlineExceededError if the time is up."""
        if self.remaining <= 0:
            raise self.too_late()

    def too_late(self) -> DeadlineExceededError:
        """The error of a call whose time is up."""
        return DeadlineExceededError(f"no complete answer within {self._timeout:g} s")

    def phases(self) -> "httpx.Timeout":
        """What is left of the deadline, for each phase of the next try."""
        self.check()
        left = max(self.remaining, MOST_EXACT_WAIT)
        return httpx.Timeout(left, connect=min(left, LONGEST_CONNECT))

    def headers(self) -> dict[str, str]:
        """The headers of the next try.

        ``Prefer: wait`` (RFC 7240) tells the service when nobody will wait any longer, so that
        it neither begins nor goes on with what would come too late.
        """
        wait = {"Prefer": f"wait={max(1, math.ceil(min(self.remaining, LONGEST_WAIT)))}"}
        return {**self.request.headers, **(wait if self.request.awaited else {})}

    def meter(
        self, stage: str, headers: Mapping[str, str] | None = None
    ) -> Callable[[bytes], None]:
        """Count the chunks of one stage of one try, and stop it when the time is up.

        Args:
            stage: ``"send"`` or ``"receive"``.
            headers: those that say how much is to come; the request's own by default.
        """
        expected = self.request.headers if headers is None else headers
        total = int(expected.get("Content-Length", 0))
        done = 0

        def seen(chunk: bytes) -> None:
            nonlocal done
            self.check()
            done += len(chunk)
            if self._on_progress is not None:
                self._on_progress(stage, done, total)

        return seen

    def translate(self, error: "httpx.TransportError") -> PugeoError:
        """Turn the HTTP library's failure to get an answer into this package's error."""
        if isinstance(error, httpx.TimeoutException) and self.remaining <= MOST_EXACT_WAIT:
            return self.too_late()
        if isinstance(error, (httpx.LocalProtocolError, httpx.UnsupportedProtocol)):
            return PugeoError(f"the request cannot be sent: {error}")
        return ConnectionFailedError(f"no answer: {type(error).__name__}: {error}".rstrip(": "))

    def wait_after(self, failure: PugeoError) -> float:
        """Seconds to wait before the next try; raises the failure if there is to be none."""
        delay = _retry.delay_before_retry(
            failure,
            attempt=self._made,
            failures=self._failed,
            max_retries=self._max_retries,
            remaining=self.remaining,
            jitter=random.random(),  # noqa: S311 - spreads load, guards nothing
        )
        if delay is None or not self.request.sendable:
            raise failure
        self._made += 1
        self._failed += not _retry.asked_to_come_again(failure)
        return delay
