# SPDX-License-Identifier: Apache-2.0
"""Errors of the engine that are not caused by the points."""

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["DiskError", "EngineLostError", "EngineStartError", "WorkerLostError", "disk_errors"]


class WorkerLostError(Exception):
    """A task ended its worker process twice: out of memory, out of time, or a crash."""


class EngineLostError(Exception):
    """The scheduler, or all results, were lost."""


class EngineStartError(Exception):
    """The workers cannot start, or were not ready within the time for it."""


class DiskError(Exception):
    """The disk of the front cannot store or return the bytes of a body or an answer.

    Attributes:
        error: of the operating system.
    """

    def __init__(self, error: OSError) -> None:
        super().__init__(str(error))
        self.error = error


@contextmanager
def disk_errors() -> Iterator[None]:
    """Raise errors of the disk within the block as such: errors of connections look alike.

    Raises:
        DiskError: an ``OSError`` was raised within.
    """
    try:
        yield
    except OSError as error:
        raise DiskError(error) from error
