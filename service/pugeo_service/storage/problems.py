# SPDX-License-Identifier: Apache-2.0
"""What a client is told when the disk does not do its part."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from pugeo_service.problems import ProblemError

__all__ = ["storage_problem", "storage_problems"]

_log = structlog.stdlib.get_logger("pugeo.storage")
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_RETRY_S = 30.0


def storage_problem(error: OSError) -> ProblemError:
    """Return what a client is told of an error of the disk; the log gets its cause."""
    _log.error("the disk fails", reason=str(error))
    if error.errno in _FULL:
        detail = "The service's disk is full; there may be room again later."
        return ProblemError(503, "storage_full", detail, retry_after=_RETRY_S)
    detail = "The service cannot use its disk at the moment."
    return ProblemError(503, "storage_failed", detail, retry_after=_RETRY_S)


@contextmanager
def storage_problems() -> Iterator[None]:
    """Turn errors of the disk within the block into problems.

    Raises:
        ProblemError: 503 ``storage_full`` or ``storage_failed``; the log has the file and the cause.
    """
    try:
        yield
    except OSError as error:
        raise storage_problem(error) from error
