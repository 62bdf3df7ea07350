# SPDX-License-Identifier: Apache-2.0
"""Room on a disk that is kept back for deleting: a database writes before it forgets."""

import os
from contextlib import suppress
from pathlib import Path

__all__ = ["Reserve"]

_BYTES = 256 << 10


class Reserve:
    """A file whose room is given up once its disk is full.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def fill(self) -> None:
        """Make the file unless it exists; do nothing if there is no room for it."""
        if self._path.exists():
            return
        part = self._path.with_name(f"{self._path.name}.part")
        try:
            # Written and not only allocated: some file systems promise no room for a hole.
            with part.open("wb") as file:
                file.write(os.urandom(_BYTES))
                os.fsync(file.fileno())
            part.replace(self._path)
        except OSError:
            with suppress(OSError):
                part.unlink()

    def release(self) -> bool:
        """Delete the file; return whether there was one."""
        try:
            self._path.unlink()
        except OSError:
            return False
        return True
