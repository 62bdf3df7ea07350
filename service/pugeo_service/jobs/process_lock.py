# SPDX-License-Identifier: Apache-2.0
"""Locks that show which processes that share a folder of jobs are running.

Each process holds a lock on its own file. The kernel releases it when the process ends for any
reason, so its jobs can be taken over at once, but never while a slow or paused process still runs,
so no job runs twice at one time. Leases with a time limit guarantee neither.
"""

import fcntl
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

__all__ = ["ProcessLock"]


class ProcessLock:
    """Lock of this process in a folder of jobs.

    Args:
        folder: folder of jobs, on a file system whose locks all processes share.

    Attributes:
        name: unique name of this process.
    """

    def __init__(self, folder: Path) -> None:
        self.name = secrets.token_hex(12)
        self._folder = folder / "runners"
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Acquire the lock. Idempotent.

        Raises:
            OSError: the folder is not writable.
        """
        if self._descriptor is not None:
            return
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Locked before it has its final name: another process removes unlocked files.
        making = self._folder / f".{self.name}"
        descriptor = os.open(making, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            making.rename(self._folder / self.name)
        except OSError:
            os.close(descriptor)
            making.unlink(missing_ok=True)
            raise
        self._descriptor = descriptor

    def release(self) -> None:
        """Release the lock. Idempotent."""
        if self._descriptor is not None:
            (self._folder / self.name).unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = None

    def is_alive(self, name: str) -> bool:
        """Whether the process of a name runs; the file of an ended process is removed."""
        if name == self.name:
            return True
        path = self._folder / name
        try:
            descriptor = os.open(path, os.O_RDWR)
        except (FileNotFoundError, IsADirectoryError):
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        else:
            path.unlink(missing_ok=True)
            return False
        finally:
            os.close(descriptor)

    def ended(self, names: Iterable[str]) -> list[str]:
        """Return the names of ended processes among ``names``."""
        return [name for name in names if not self.is_alive(name)]

    @property
    def is_only_process(self) -> bool:
        """Whether no other process uses the folder."""
        others = [path.name for path in self._folder.iterdir() if not path.name.startswith(".")]
        return not [name for name in others if name != self.name and self.is_alive(name)]
