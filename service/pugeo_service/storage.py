# SPDX-License-Identifier: Apache-2.0
"""What a client is told when the disk does not do its part."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from pugeo_service.problems import Problem

__all__ = ["storage_problems"]

_log = structlog.stdlib.get_logger("pugeo.storage")
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_RETRY_S = 30.0


@contextmanager
def storage_problems() -> Iterator[None]:
    """Turn errors of the disk within the block into problems.

    Raises:
        Problem: 503 ``storage_full`` or ``storage_failed``; the log has the file and the cause.
    """
    try:
        yield
    except OSError as error:
        _log.error("the disk fails", reason=str(error))
        if error.errno in _FULL:
            detail = "The service's disk is full; there may be room again later."
            raise Problem(503, "storage_full", detail, retry_after=_RETRY_S) from error
        detail = "The service cannot write to its disk at the moment."
        raise Problem(503, "storage_failed", detail, retry_after=_RETRY_S) from error
