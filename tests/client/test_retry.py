# SPDX-License-Identifier: Apache-2.0
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pugeo_client._retry import FIRST_BACKOFF, MAX_BACKOFF, MAX_RETRY_AFTER, delay_before_retry
from pugeo_client.errors import (
    ConnectionFailedError,
    DeadlineExceededError,
    InvalidResponseError,
    PugeoError,
    SourceError,
    StatusError,
)


def decide(failure: PugeoError, **changes: Any) -> float | None:
    given: dict[str, Any] = {
        "attempt": 0,
        "failures": 0,
        "max_retries": 3,
        "remaining": 1e9,
        "jitter": 0.5,
    }
    return delay_before_retry(failure, **(given | changes))


def status(code: int, **fields: Any) -> StatusError:
    return StatusError(code, code="x", detail="x", **fields)


@pytest.mark.parametrize("code", [408, 425, 429, 502, 503, 504])
def test_transient_statuses_are_retried(code: int) -> None:
    """Statuses that may pass are retried."""
    assert decide(status(code)) is not None


@pytest.mark.parametrize("code", [400, 401, 404, 409, 413, 415, 422, 500, 501])
def test_permanent_statuses_are_not(code: int) -> None:
    """A request that would fail again is not retried."""
    assert decide(status(code)) is None


def test_the_service_decides() -> None:
    """`retryable: false` prevents the retry of a transient status."""
    assert decide(status(503, retryable=False)) is None
    assert decide(status(503, retryable=True)) is not None


@pytest.mark.parametrize(
    "failure", [DeadlineExceededError(), SourceError(), InvalidResponseError(), PugeoError()]
)
def test_local_errors_are_not_retried(failure: PugeoError) -> None:
    """Errors of this side, and a deadline that has passed, end the call."""
    assert decide(failure) is None


def test_connection_failures_are_retried() -> None:
    """A refused or broken connection is retried."""
    assert decide(ConnectionFailedError()) is not None


@given(
    attempt=st.integers(0, 60),
    jitter=st.floats(0, 1, exclude_max=True),
    asked=st.none() | st.floats(0, 1000),
    remaining=st.floats(0, 500),
)
def test_delays_keep_every_bound(
    attempt: int, jitter: float, asked: float | None, remaining: float
) -> None:
    """A wait is never shorter than Retry-After, never beyond the deadline or its own limit."""
    failure = status(503, retry_after=asked)
    delay = decide(failure, attempt=attempt, max_retries=99, jitter=jitter, remaining=remaining)
    if delay is None:
        assert remaining <= (asked or 0) + MAX_BACKOFF or (asked or 0) > MAX_RETRY_AFTER
        return
    assert delay < remaining
    if asked is None:
        backoff = min(FIRST_BACKOFF * 2.0**attempt, MAX_BACKOFF)
        assert backoff / 2 <= delay <= backoff
    else:
        assert asked <= MAX_RETRY_AFTER
        assert asked <= delay <= asked + MAX_BACKOFF


def test_retries_are_counted() -> None:
    """After max_retries failures there is no further retry."""
    delays = [decide(ConnectionFailedError(), attempt=made, failures=made) for made in range(5)]
    assert [delay is None for delay in delays] == [False, False, False, True, True]


def test_overload_is_retried_until_the_deadline() -> None:
    """Overload does not count as a failure, unless retries are off or Retry-After is missing."""
    full = {"attempt": 50, "failures": 3}
    for code in (429, 503):
        assert decide(status(code, retry_after=2.0), **full) is not None
        assert decide(status(code, retry_after=2.0), **full, remaining=1.0) is None
        assert decide(status(code, retry_after=2.0), **full, max_retries=0) is None
        assert decide(status(code), **full) is None
    assert decide(status(502, retry_after=2.0), **full) is None


def test_many_attempts_do_not_overflow() -> None:
    """The backoff is limited before it can overflow, at 1,024 attempts and more."""
    delay = decide(ConnectionFailedError(), attempt=5000, max_retries=math.inf)
    assert delay is not None
    assert delay <= MAX_BACKOFF
