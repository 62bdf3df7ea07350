# SPDX-License-Identifier: Apache-2.0
"""Errors of the engine that are not caused by the points."""

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = [
    "DiskError",
    "EngineLostError",
    "EngineStartError",
    "WorkerLostError",
    "WrongWeightsError",
    "disk_errors",
]


class WorkerLostError(Exception):
    """A task ended its worker process twice: out of memory, out of time, or a crash."""


class EngineLostError(Exception):
    """The scheduler, or all results, were lost."""


class EngineStartError(Exception):
    """The workers cannot start, or were not ready within the time for it."""


class WrongWeightsError(Exception):
    """A worker has other weights of a name than the front.

    Args:
        name: of the model.
        found: sha256 that the worker has, or "none".
        wanted: sha256 that the front asks for.
    """

    def __init__(self, name: str, found: str, wanted: str) -> None:
        # All arguments, so that the error survives the way to the front.
        super().__init__(name, found, wanted)

    def __str__(self) -> str:
        name, found, wanted = self.args
        return (
            f"a worker has the weights {found[:12]} as {name!r}, this service {wanted[:12]}: run "
            "the same version of pugeo on all machines"
        )


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
