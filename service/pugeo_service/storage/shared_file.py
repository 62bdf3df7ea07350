# SPDX-License-Identifier: Apache-2.0
"""A file of one process that other processes of the same machine write into.

Bytes sent through a connection are encrypted in records of 16 kB, each of which costs both sides an
iteration of their event loops. On the same machine a worker writes an answer to the file directly.
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

_TOKEN = 16  # random bytes at the start of the file, which identify it
_NEEDED = ("pread", "pwrite", "O_CLOEXEC", "O_NONBLOCK")  # of the system; Windows lacks them


@dataclass(frozen=True)
class SharedFile:
    """Reference to a file without a name.

    Attributes:
        path: ``/proc`` path of the file through the process that has it open. On another machine,
            or after that process has closed the file, it names no file or another one.
        token: first bytes of the file, checked before writing, because numbers of processes,
            descriptors and inodes are reused.
    """

    path: str
    token: bytes

    @property
    def start(self) -> int:
        """Offset of the shared bytes in the file."""
        return len(self.token)

    def put(self, data: NDArray[np.uint8], offset: int) -> bool:
        """Write bytes after the first ``offset`` shared bytes.

        Returns:
            True if all were written. If not, previous bytes at that place may be overwritten.
            False where the system has no ``/proc``, or cannot write at a place of an open file.
        """
        if not all(hasattr(os, name) for name in _NEEDED):
            return False
        try:
            # O_NONBLOCK: the path may by now name a pipe without a reader.
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
            # The process that owns the file writes the bytes then, and reports a full disk.
            return False
        finally:
            os.close(descriptor)
        return True


NOWHERE = SharedFile("", b"")
"""Refers to no file; `SharedFile.put` returns False."""


def shared_file(folder: Path) -> tuple[IO[bytes], SharedFile]:
    """Make a file without a name in a folder; shared bytes follow its token.

    Raises:
        OSError: the file cannot be made.
    """
    file = TemporaryFile(dir=folder)  # noqa: SIM115
    try:
        token = secrets.token_bytes(_TOKEN)
        # Not os.write by number: after a close the number may belong to another file.
        file.write(token)
        file.flush()
        return file, SharedFile(f"/proc/{os.getpid()}/fd/{file.fileno()}", token)
    except BaseException:
        with suppress(OSError):
            file.close()
        raise
