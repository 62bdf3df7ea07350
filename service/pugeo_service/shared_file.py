# SPDX-License-Identifier: Apache-2.0
"""A file of one process that others of the same machine write into.

What goes through a connection is encrypted in records of 16 kB, each of which costs both sides a
turn of their event loops. On one machine the file that an answer goes to can be had directly.
"""

import os
import secrets
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["SharedFile"]

_TOKEN = 16  # bytes at the start of the file that tell it from any other


@dataclass(frozen=True)
class SharedFile:
    """How to reach a file that has no name.

    Attributes:
        path: through the process that has it open. It leads nowhere on another machine, or where
            there is no ``/proc``, and elsewhere once that process has closed it.
        token: what the file begins with: numbers of processes, files and inodes come again.
    """

    path: str
    token: bytes

    @classmethod
    def of(cls, descriptor: int) -> Self:
        """Prepare an empty file, open in this process."""
        token = secrets.token_bytes(_TOKEN)
        os.pwrite(descriptor, token, 0)
        return cls(f"/proc/{os.getpid()}/fd/{descriptor}", token)

    @property
    def start(self) -> int:
        """Where in the file the shared bytes begin."""
        return len(self.token)

    def put(self, data: NDArray[np.uint8], offset: int) -> bool:
        """Write bytes behind the first ``offset`` shared ones.

        Returns:
            Whether they are there. What was in their place may be lost either way.
        """
        try:
            # Neither made where there is none, nor waited for where it is something else.
            descriptor = os.open(self.path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError:
            return False
        try:
            if os.pread(descriptor, len(self.token), 0) != self.token:
                return False
            rest, at = data.data, self.start + offset
            while rest:
                written = os.pwrite(descriptor, rest, at)
                rest, at = rest[written:], at + written
        except OSError:
            # A disk that is full tells the process whose file it is, as soon as that one writes.
            return False
        finally:
            os.close(descriptor)
        return True
