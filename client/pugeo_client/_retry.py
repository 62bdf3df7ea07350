# SPDX-License-Identifier: Apache-2.0
"""When to try again, and how long to wait before: pure functions, no clock and no sleep."""

from pugeo_client.errors import (
    ConnectionFailedError,
    DeadlineExceededError,
    PugeoError,
    StatusError,
)

__all__ = ["asked_to_come_again", "delay_before_retry", "may_succeed_later"]

RETRIED_STATUS = frozenset({408, 425, 429, 502, 503, 504})
RETRY_AFTER_CAP = 120.0
"""Seconds. A service that asks for a longer wait gets none: its error is raised instead."""
FIRST_DELAY = 0.5
LONGEST_DELAY = 8.0


def delay_before_retry(
    failure: PugeoError,
    *,
    attempt: int,
    failures: int,
    max_retries: int,
    remaining: float,
    jitter: float,
) -> float | None:
    """Decide whether to try again after a failure.

    A service that is full and says when to come again did not fail: it is asked again for as long
    as there is time. In a crowd only one in many gets in at each try, whatever it did wrong.

    Args:
        failure: what the attempt ended with.
        attempt: how many retries came before, 0 after the first try.
        failures: how many of them came after a failure, and not because the service was full.
        max_retries: how many failures are retried; 0 for no retry at all.
        remaining: seconds left of the call's total timeout.
        jitter: uniform in [0, 1). Spreads clients that failed together.

    Returns:
        Seconds to wait before the next try, or None: raise the failure.
    """
    if not may_succeed_later(failure) or not max_retries:
        return None
    if failures >= max_retries and not asked_to_come_again(failure):
        return None
    backoff = min(FIRST_DELAY * 2.0**attempt, LONGEST_DELAY)
    asked = failure.retry_after if isinstance(failure, StatusError) else None
    if asked is None:
        delay = backoff * (0.5 + 0.5 * jitter)
    elif asked > RETRY_AFTER_CAP:
        return None
    else:
        # Never earlier than asked, and the later the more often it was in vain.
        delay = asked + backoff * jitter
    return delay if delay < remaining else None


def asked_to_come_again(failure: PugeoError) -> bool:
    """Whether the service is full, for everybody or for this client, and says until when."""
    return (
        isinstance(failure, StatusError)
        and failure.status in (429, 503)
        and failure.retry_after is not None
    )


def may_succeed_later(failure: PugeoError) -> bool:
    """Whether the same request may succeed at another time."""
    if isinstance(failure, StatusError):
        return failure.status in RETRIED_STATUS and failure.retryable is not False
    return isinstance(failure, ConnectionFailedError) and not isinstance(
        failure, DeadlineExceededError
    )
