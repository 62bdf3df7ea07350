# SPDX-License-Identifier: Apache-2.0
"""Retry policy: pure functions, without a clock."""

from pugeo_client.errors import (
    ConnectionFailedError,
    DeadlineExceededError,
    PugeoError,
    ServerDeadlineError,
    StatusError,
)

__all__ = ["delay_before_retry", "is_overload", "is_transient", "worth_a_job"]

RETRIED_STATUS = frozenset({408, 425, 429, 502, 503, 504})
MAX_RETRY_AFTER = 120.0
"""Seconds. If a service asks for a longer wait, its error is raised instead."""
FIRST_BACKOFF = 0.5  # seconds
MAX_BACKOFF = 8.0  # seconds
MIN_JOB_TIME = 1.0  # seconds


def delay_before_retry(
    failure: PugeoError,
    *,
    attempt: int,
    failures: int,
    max_retries: int,
    remaining: float,
    jitter: float,
) -> float | None:
    """Decide whether to retry after a failure, and after how many seconds.

    Overload (see `is_overload`) does not count as a failure: it is retried until the deadline,
    because with many clients most attempts are refused although nothing is wrong.
    Otherwise exponential backoff with jitter.

    Args:
        failure: error of the last attempt.
        attempt: retries made so far, 0 after the first attempt.
        failures: how many of them followed a failure other than overload.
        max_retries: limit of ``failures``; 0 turns all retries off.
        remaining: seconds until the deadline of the call.
        jitter: uniform in [0, 1); spreads clients that failed at the same time.

    Returns:
        Seconds to wait before the next attempt, or None to raise the failure.
    """
    if not is_transient(failure) or not max_retries:
        return None
    if failures >= max_retries and not is_overload(failure):
        return None
    backoff = min(FIRST_BACKOFF * 2.0 ** min(attempt, 60), MAX_BACKOFF)
    asked = failure.retry_after if isinstance(failure, StatusError) else None
    if asked is None:
        delay = backoff * (0.5 + 0.5 * jitter)
    elif asked > MAX_RETRY_AFTER:
        return None
    else:
        # Never earlier than the service asked.
        delay = asked + backoff * jitter
    return delay if delay < remaining else None


def is_overload(failure: PugeoError) -> bool:
    """Tell whether the service is full and named a time to come back (429 or 503)."""
    return (
        isinstance(failure, StatusError)
        and failure.status in (429, 503)
        and failure.retry_after is not None
    )


def is_transient(failure: PugeoError) -> bool:
    """Tell whether the same request may succeed later."""
    if isinstance(failure, StatusError):
        return failure.status in RETRIED_STATUS and failure.retryable is not False
    return isinstance(failure, ConnectionFailedError) and not isinstance(
        failure, DeadlineExceededError
    )


def worth_a_job(failure: ServerDeadlineError, remaining: float) -> bool:
    """Tell whether a job may finish a cloud that took too long for one request.

    Args:
        failure: answer to the request.
        remaining: seconds until the deadline of the call.

    Returns:
        False where the deadline of the call itself is what leaves too little time.
    """
    left = failure.fields.get("seconds_left", 0.0)  # that the service had for the cloud
    allowed = left if isinstance(left, (int, float)) else 0.0
    return remaining > allowed + MIN_JOB_TIME
