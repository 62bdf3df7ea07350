# SPDX-License-Identifier: Apache-2.0
"""A file of one process that others of the same machine write into.

What goes through a connection is encrypted in records of 16 kB, each of which costs both sides a
turn of their event loops. On one machine the file that an answer goes to can be had directly.
"""

import os
import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray

__all__ = ["NOWHERE", "SharedFile", "shared_file"]

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


NOWHERE = SharedFile("", b"")
"""Of no file: whatever is to be put there is not."""


def shared_file(folder: Path) -> tuple[IO[bytes], SharedFile]:
    """Make a file without a name in a folder; what goes into it comes behind what is there now.

    Raises:
        OSError: the disk takes none.
    """
    file = TemporaryFile(dir=folder)  # noqa: SIM115
    try:
        token = secrets.token_bytes(_TOKEN)
        # By the file and not by its number, which may be another's once this one is closed.
        file.write(token)
        file.flush()
        return file, SharedFile(f"/proc/{os.getpid()}/fd/{file.fileno()}", token)
    except BaseException:
        with suppress(OSError):
            file.close()
        raise
