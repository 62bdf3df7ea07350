# SPDX-License-Identifier: Apache-2.0
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pugeo_client._retry import FIRST_DELAY, LONGEST_DELAY, RETRY_AFTER_CAP, delay_before_retry
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
def test_passing_states_are_retried(code: int) -> None:
    """The statuses that mean "not now" are tried again."""
    assert decide(status(code)) is not None


@pytest.mark.parametrize("code", [400, 401, 404, 409, 413, 415, 422, 500, 501])
def test_lasting_states_are_not(code: int) -> None:
    """A request that will fail again is not sent again."""
    assert decide(status(code)) is None


def test_the_service_has_the_last_word() -> None:
    """`retryable: false` forbids a retry of a status that would get one."""
    assert decide(status(503, retryable=False)) is None
    assert decide(status(503, retryable=True)) is not None


@pytest.mark.parametrize(
    "failure", [DeadlineExceededError(), SourceError(), InvalidResponseError(), PugeoError()]
)
def test_what_no_retry_can_mend(failure: PugeoError) -> None:
    """Errors on this side, and a spent deadline, end the call."""
    assert decide(failure) is None


def test_no_connection_is_retried() -> None:
    """A refused or broken connection is tried again."""
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
    """A wait is never shorter than asked for, never past the deadline, never past its cap."""
    failure = status(503, retry_after=asked)
    delay = decide(failure, attempt=attempt, max_retries=99, jitter=jitter, remaining=remaining)
    if delay is None:
        assert remaining <= (asked or 0) + LONGEST_DELAY or (asked or 0) > RETRY_AFTER_CAP
        return
    assert delay < remaining
    if asked is None:
        backoff = min(FIRST_DELAY * 2.0**attempt, LONGEST_DELAY)
        assert backoff / 2 <= delay <= backoff
    else:
        assert asked <= RETRY_AFTER_CAP
        assert asked <= delay <= asked + LONGEST_DELAY


def test_retries_are_counted() -> None:
    """After max_retries tries the failure stands."""
    delays = [decide(ConnectionFailedError(), attempt=made, failures=made) for made in range(5)]
    assert [delay is None for delay in delays] == [False, False, False, True, True]


def test_a_full_service_is_asked_until_the_time_is_up() -> None:
    """However often it said no; but not where nobody wants a retry, or it does not say when."""
    full = {"attempt": 50, "failures": 3}
    for code in (429, 503):
        assert decide(status(code, retry_after=2.0), **full) is not None
        assert decide(status(code, retry_after=2.0), **full, remaining=1.0) is None
        assert decide(status(code, retry_after=2.0), **full, max_retries=0) is None
        assert decide(status(code), **full) is None
    assert decide(status(502, retry_after=2.0), **full) is None


def test_an_endless_attempt_number_does_not_overflow() -> None:
    """Backoff is capped before it can grow without bound."""
    delay = decide(ConnectionFailedError(), attempt=1000, max_retries=math.inf)
    assert delay is not None
    assert delay <= LONGEST_DELAY
