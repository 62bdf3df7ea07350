# SPDX-License-Identifier: Apache-2.0
"""Which processes that use a folder of jobs are alive.

Each holds a lock on a file of its own. The kernel lets go of it when the process ends, however it
ends, so its jobs can be taken over at once; and never while it lives, however slow or paused it
is, so no job ever runs twice at one time. Leases by the clock would give neither.
"""

import fcntl
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

__all__ = ["Presence"]


class Presence:
    """This process among those that share a folder.

    Args:
        folder: of the jobs, on a file system with locks that all processes see.

    Attributes:
        name: of this process; no other ever has the same.
    """

    def __init__(self, folder: Path) -> None:
        self.name = secrets.token_hex(12)
        self._folder = folder / "runners"
        self._descriptor: int | None = None

    def enter(self) -> None:
        """Be alive for the others.

        Raises:
            OSError: the folder cannot be written to.
        """
        if self._descriptor is not None:
            return
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Locked before it has its name, or another process might find it free and take it away.
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

    def leave(self) -> None:
        """Be gone for the others."""
        if self._descriptor is not None:
            (self._folder / self.name).unlink(missing_ok=True)
            os.close(self._descriptor)
            self._descriptor = None

    def alive(self, name: str) -> bool:
        """Whether the process of a name runs; forgets one that does not."""
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

    def dead(self, names: Iterable[str]) -> list[str]:
        """Return those of the names whose processes are gone."""
        return [name for name in names if not self.alive(name)]

    @property
    def alone(self) -> bool:
        """Whether no other process uses the folder."""
        others = [path.name for path in self._folder.iterdir() if not path.name.startswith(".")]
        return not [name for name in others if name != self.name and self.alive(name)]
