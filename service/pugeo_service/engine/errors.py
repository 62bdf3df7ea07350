# SPDX-License-Identifier: Apache-2.0
"""What can go wrong in the engine that is no fault of the points themselves."""

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["DiskError", "EngineLostError", "WorkerLostError", "disk"]


class WorkerLostError(Exception):
    """A task ended its worker process twice: out of memory, out of time, or a crash."""


class EngineLostError(Exception):
    """The scheduler or all results on it are gone."""


class DiskError(Exception):
    """The disk of the front does not take or give the bytes of a body or an answer.

    Attributes:
        error: what it said.
    """

    def __init__(self, error: OSError) -> None:
        super().__init__(str(error))
        self.error = error


@contextmanager
def disk() -> Iterator[None]:
    """Tell errors of the disk within the block from those of connections, which look alike.

    Raises:
        DiskError: an ``OSError`` was raised within.
    """
    try:
        yield
    except OSError as error:
        raise DiskError(error) from error
