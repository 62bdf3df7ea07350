# SPDX-License-Identifier: Apache-2.0
"""The attempts of one call: deadline, retries and progress."""

import math
import random
import time
from collections.abc import Callable
from typing import TypeAlias

from pugeo_client import _retry
from pugeo_client._http import httpx, to_package_error
from pugeo_client._requests import Request
from pugeo_client.errors import (
    ConfigurationError,
    DeadlineExceededError,
    PugeoError,
    ServerDeadlineError,
)

__all__ = ["Attempts", "Progress"]

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with a stage (``"send"``, ``"receive"``), bytes done and bytes in total (0: unknown)."""

MAX_CONNECT_S = 10.0  # a host that drops packets costs one retry, not the whole call
MIN_TIMEOUT_S = 1e-3  # the HTTP library refuses 0
MAX_WAIT_S = 1e6  # largest value in a header, for a timeout of infinity


class Attempts:
    """State of one call, from its first attempt to the end of its last.

    Args:
        request: sent at each attempt.
        url: address of the service, for messages.
        timeout: seconds for all attempts and the waits between them.
        max_retries: retries after failures; overload of the service does not count.
        on_progress: called after every chunk, or None.

    Raises:
        ConfigurationError: the timeout is no number of seconds.
    """

    def __init__(
        self,
        request: Request,
        *,
        url: str,
        timeout: float,
        max_retries: int,
        on_progress: Progress | None = None,
    ) -> None:
        if math.isnan(timeout):
            raise ConfigurationError("timeout must be a number of seconds, not NaN")
        self.request = request
        self._url = url
        self._on_progress = on_progress
        self._timeout = timeout
        self._end = time.monotonic() + timeout
        self._max_retries = max_retries
        self._retries = 0
        self._failures = 0

    @property
    def remaining(self) -> float:
        """Seconds until the deadline; negative after it."""
        return self._end - time.monotonic()

    def checked_remaining(self) -> float:
        """Return the seconds until the deadline.

        Raises:
            DeadlineExceededError: there are none.
        """
        remaining = self.remaining
        if remaining <= 0:
            raise self.deadline_error()
        return remaining

    def deadline_error(self) -> DeadlineExceededError:
        """Return the error of a call whose time is up."""
        return DeadlineExceededError(f"no complete answer within {self._timeout:g} s")

    def timeouts(self) -> "httpx.Timeout":
        """Return the timeouts of the next attempt."""
        left = max(self.checked_remaining(), MIN_TIMEOUT_S)
        return httpx.Timeout(left, connect=min(left, MAX_CONNECT_S))

    def headers(self) -> dict[str, str]:
        """Return the headers of the next attempt.

        ``Prefer: wait`` (RFC 7240) tells the service when this client gives up, so that it does
        not work on an answer that nobody will read.
        """
        if not self.request.timed:
            return dict(self.request.headers)
        seconds = max(1, math.ceil(min(self.remaining, MAX_WAIT_S)))
        return {**self.request.headers, "Prefer": f"wait={seconds}"}

    def byte_counter(
        self, stage: str, total: int, *, report: bool = True
    ) -> Callable[[bytes], None]:
        """Return a function that counts chunks, reports progress and keeps the deadline.

        Args:
            stage: ``"send"`` or ``"receive"``.
            total: expected bytes, or 0.
            report: whether to call ``on_progress``.
        """
        done = 0

        def count(chunk: bytes) -> None:
            nonlocal done
            self.checked_remaining()
            done += len(chunk)
            if report and self._on_progress is not None:
                self._on_progress(stage, done, total)

        return count

    def error_from(self, error: Exception) -> PugeoError:
        """Turn an error of the HTTP library into one of this package."""
        if isinstance(error, httpx.TimeoutException) and self.remaining <= MIN_TIMEOUT_S:
            return self.deadline_error()
        return to_package_error(error, self._url)

    def delay_after(self, failure: PugeoError) -> float:
        """Return the seconds to wait before the next attempt; or raise the failure."""
        delay = _retry.delay_before_retry(
            failure,
            attempt=self._retries,
            failures=self._failures,
            max_retries=self._max_retries,
            remaining=self.remaining,
            jitter=random.random(),  # noqa: S311 - spreads load, guards nothing
        )
        # A cloud that exceeded the time limit of the service would exceed it again.
        hopeless = self.request.timed and isinstance(failure, ServerDeadlineError)
        if delay is None or hopeless or not self.request.sendable:
            raise failure
        self._retries += 1
        self._failures += not _retry.is_overload(failure)
        return delay
