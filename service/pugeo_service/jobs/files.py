# SPDX-License-Identifier: Apache-2.0
"""Files of jobs: atomic and durable inputs and results."""

import asyncio
import errno
import hashlib
import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.atomic_file import AtomicFile

__all__ = ["InputLostError", "JobFiles", "ResultLostError", "StoredInput"]

_MOST_CHECKED = 10_000


class InputLostError(Exception):
    """The input of a job is missing, or differs from the accepted one."""


class ResultLostError(Exception):
    """The result of a job differs from the one that was stored."""


class StoredInput:
    """The input of a job, read when the engine needs it."""

    def __init__(self, path: Path, size: int, sha256: str) -> None:
        self._path = path
        self._sha256 = sha256
        self.size = size

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``.

        Raises:
            InputLostError: the file is missing or changed.
        """
        return await asyncio.to_thread(self._read)

    def _read(self) -> NDArray[np.uint8]:
        try:
            data = np.fromfile(self._path, np.uint8)
        except FileNotFoundError as error:
            raise InputLostError("the file is missing") from error
        if hashlib.sha256(data.data).hexdigest() != self._sha256:
            raise InputLostError("its bytes have changed")
        return data


class JobFiles:
    """The folder of inputs and results.

    Args:
        folder: the folder; created, private to this user, if it does not exist.
        writer: name of this process, with which the names of its incomplete files begin.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        self._writer = writer
        self._folder = folder
        self._parts = folder / "parts"
        self._inputs = folder / "inputs"
        self._results = folder / "results"
        # Size, time and inode of results whose digest is right.
        self._checked: dict[str, tuple[int, int, int]] = {}

    def prepare(self) -> None:
        """Make the folders.

        Raises:
            OSError: they cannot be made, or are not writable.
        """
        _make_private(self._folder)
        for folder in (self._parts, self._inputs, self._results):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Permissions alone do not show that a file can be made.
        probe = self._parts / f"{self._writer}.probe"
        probe.touch()
        probe.unlink()

    def new_input(self, job_id: str) -> AtomicFile:
        """Start writing the input of a job."""
        return AtomicFile(self._parts / f"{self._writer}.{job_id}.in", self._inputs / job_id)

    def new_result(self, job_id: str) -> AtomicFile:
        """Start writing the result of a job."""
        return AtomicFile(self._parts / f"{self._writer}.{job_id}.out", self._results / job_id)

    def input_path(self, job_id: str) -> Path:
        """Return the path of the input of a job, which may not exist."""
        return self._inputs / job_id

    def input(self, job_id: str, size: int, sha256: str) -> StoredInput:
        """Return the input of a job."""
        return StoredInput(self._inputs / job_id, size, sha256)

    def result(self, job_id: str, size: int, sha256: str) -> Path:
        """Return the path of the result of a job; it accesses the disk.

        The bytes are compared with their digest once, and again whenever the file has changed.

        Raises:
            FileNotFoundError: there is no such file.
            ResultLostError: its bytes have changed.
        """
        path = self._results / job_id
        with path.open("rb") as file:
            seen = _stamp(os.fstat(file.fileno()))
            if self._checked.get(job_id) != seen:
                if seen[0] != size or hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                    raise ResultLostError("its bytes have changed")
                self._checked[job_id] = seen
                while len(self._checked) > _MOST_CHECKED:
                    self._checked.pop(next(iter(self._checked)), None)
        return path

    def remove_input(self, job_id: str) -> None:
        """Remove the input of a job, if it exists."""
        _remove(self._inputs / job_id)

    def remove_result(self, job_id: str) -> None:
        """Remove the result of a job, if it exists."""
        self._checked.pop(job_id, None)
        _remove(self._results / job_id)

    def sweep(
        self,
        inputs: set[str],
        results: set[str],
        made_before: float,
        is_alive: Callable[[str], bool],
    ) -> int:
        """Remove files that no job needs; return their number.

        Args:
            inputs: ids of jobs whose inputs are needed.
            results: ids of jobs whose results are needed.
            made_before: inputs and results modified later are kept, seconds since 1970. This must
                be earlier than the query of the ids.
            is_alive: returns True if the process of a name runs.
        """
        removed = 0
        for folder, kept in ((self._inputs, inputs), (self._results, results)):
            for path in folder.iterdir():
                if path.name not in kept and _modified(path) <= made_before:
                    removed += _remove(path)
        for path in self._parts.iterdir():
            writer = path.name.partition(".")[0]
            if not is_alive(writer):
                removed += _remove(path)
        return removed


def _make_private(folder: Path) -> None:
    """Make a folder; refuse one of another user in a shared folder such as /tmp."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    # Windows has no such folders, and no numbers of users.
    shared = hasattr(os, "geteuid") and folder.parent.stat().st_mode & stat.S_ISVTX
    if shared and (folder.is_symlink() or folder.stat().st_uid != os.geteuid()):
        raise PermissionError(errno.EPERM, "it belongs to another user", str(folder))


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True


def _stamp(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_size, status.st_mtime_ns, status.st_ino


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return float("inf")
