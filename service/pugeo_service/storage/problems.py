# SPDX-License-Identifier: Apache-2.0
"""Problems that report errors of the disk to clients."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from pugeo_service.problems import ProblemError
from pugeo_service.storage.object_store import StoreError

__all__ = ["storage_problem", "storage_problems"]

_log = structlog.stdlib.get_logger("pugeo.storage")
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_RETRY_S = 30.0


def storage_problem(error: OSError) -> ProblemError:
    """Return the problem for an error of the disk; the cause is logged."""
    kind = "store error" if isinstance(error, StoreError) else "disk error"
    _log.error(kind, reason=str(error))
    if error.errno in _FULL:
        detail = "The disk of the service is full; try again after the time in Retry-After."
        return ProblemError(503, "storage_full", detail, retry_after=_RETRY_S)
    if isinstance(error, StoreError):
        detail = "The store of jobs fails; try again after the time in Retry-After."
        return ProblemError(503, "storage_failed", detail, retry_after=_RETRY_S)
    detail = "The disk of the service fails; try again after the time in Retry-After."
    return ProblemError(503, "storage_failed", detail, retry_after=_RETRY_S)


@contextmanager
def storage_problems() -> Iterator[None]:
    """Raise errors of the disk within the block as problems.

    Raises:
        ProblemError: 503 ``storage_full`` or ``storage_failed``; file and cause are logged.
    """
    try:
        yield
    except OSError as error:
        raise storage_problem(error) from error
