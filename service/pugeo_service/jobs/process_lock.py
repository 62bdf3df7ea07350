# SPDX-License-Identifier: Apache-2.0
"""Locks that show which processes that share a folder of jobs are running.

Each process holds a lock on its own file. The kernel releases it when the process ends for any
reason, so its jobs can be taken over at once, but never while a slow or paused process still runs,
so no job runs twice at one time. Leases with a time limit guarantee neither. Where the system has
no such locks, the file names the process, and its number tells whether it runs.
"""

import secrets
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

__all__ = ["ProcessLock"]

_ACQUIRE_S = 5.0  # another process may hold the lock for a moment, to see whether this one runs
_PROBE_S = 0.05


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
        self._lock = self._lock_of(self.name)

    def acquire(self) -> None:
        """Acquire the lock. Idempotent.

        Raises:
            OSError: the folder is not writable.
        """
        if not self._lock.is_locked:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock.acquire(timeout=_ACQUIRE_S)

    def release(self) -> None:
        """Release the lock. Idempotent."""
        if self._lock.is_locked:
            self._remove(self._lock)

    def is_alive(self, name: str) -> bool:
        """Whether the process of a name runs; the file of an ended process is removed."""
        if name == self.name:
            return True
        if not (self._folder / name).is_file():
            return False
        probe = self._lock_of(name)
        try:
            probe.acquire(timeout=_PROBE_S, poll_interval=_PROBE_S / 2)
        except Timeout:
            return True
        self._remove(probe)
        return False

    def ended(self, names: Iterable[str]) -> list[str]:
        """Return the names of ended processes among ``names``."""
        return [name for name in names if not self.is_alive(name)]

    @property
    def is_only_process(self) -> bool:
        """Whether no other process uses the folder."""
        others = [path.name for path in self._folder.iterdir() if not path.name.startswith(".")]
        return not [name for name in others if name != self.name and self.is_alive(name)]

    def _lock_of(self, name: str) -> FileLock:
        # Threads of one process take turns with it.
        return FileLock(self._folder / name, thread_local=False)

    @staticmethod
    def _remove(lock: FileLock) -> None:
        """Release a lock and remove its file; a name is never used again."""
        path = Path(lock.lock_file)
        # While it is held, so that a process that has just made the file sees that it is gone.
        # Windows removes no open file.
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
        lock.release()
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
