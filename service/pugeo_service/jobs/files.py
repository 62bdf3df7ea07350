# SPDX-License-Identifier: Apache-2.0
"""The files of jobs: there in whole, on disk for good, or not there at all."""

import asyncio
import contextlib
import errno
import hashlib
import os
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.spool import Sink

__all__ = ["InputLostError", "JobFiles", "NewFile", "StoredInput"]


class InputLostError(Exception):
    """The input of a job is not, or no longer, what was accepted."""


class NewFile(Sink):
    """A file that appears under its name once it is complete and on the disk.

    Args:
        part: where it is written.
        target: where it appears.

    Attributes:
        size: bytes taken.
    """

    def __init__(self, part: Path, target: Path) -> None:
        super().__init__()
        self._part = part
        self._target = target
        self._file: BinaryIO | None = None
        self._sha256 = hashlib.sha256()
        # Whoever is cancelled leaves a thread behind that still stores. It must not open a file
        # that nobody will close, and nobody may wait for it in the event loop: so the one of the
        # two that comes last tidies up.
        self._busy = threading.Lock()
        self._closed = False

    @property
    def sha256(self) -> str:
        """Digest of what was written, once it is committed."""
        return self._sha256.hexdigest()

    async def commit(self) -> None:
        """Make the file appear; when this returns, a power cut cannot undo it.

        Raises:
            OSError: the disk is full or fails; `close` removes what was written.
        """
        await self.flush()
        await asyncio.to_thread(self._publish)

    def close(self) -> None:
        """Remove what was written and not committed."""
        super().close()
        self._closed = True
        self._tidy()

    def _store(self, data: bytearray) -> None:
        with self._at_work() as file:
            if file is not None:
                self._sha256.update(data)
                file.write(data)

    def _publish(self) -> None:
        with self._at_work() as file:
            if file is not None:
                file.flush()
                os.fsync(file.fileno())
                file.close()
                self._file = None
                self._part.replace(self._target)
                _sync_folder(self._target.parent)

    @contextlib.contextmanager
    def _at_work(self) -> Iterator[BinaryIO | None]:
        """The open file, to a thread that works on it; ``None`` where it is not wanted any more."""
        try:
            with self._busy:
                if self._file is None and not self._closed:
                    descriptor = os.open(self._part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                    self._file = os.fdopen(descriptor, "wb")
                yield None if self._closed else self._file
        finally:
            if self._closed:
                self._tidy()

    def _tidy(self) -> None:
        """Remove what is left, unless a thread is at work, which then does it."""
        if not self._busy.acquire(blocking=False):
            return
        try:
            if self._file is not None:
                # A full disk may refuse what the buffer still holds; it is not wanted any more.
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None
            self._part.unlink(missing_ok=True)
        finally:
            self._busy.release()


class StoredInput:
    """The input of a job, read whole when the engine asks for it."""

    def __init__(self, path: Path, size: int, sha256: str) -> None:
        self._path = path
        self._sha256 = sha256
        self.size = size

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``.

        Raises:
            InputLostError: they are gone, or others than were accepted.
        """
        return await asyncio.to_thread(self._read)

    def _read(self) -> NDArray[np.uint8]:
        try:
            data = np.fromfile(self._path, np.uint8)
        except FileNotFoundError as error:
            raise InputLostError("the file is gone") from error
        if hashlib.sha256(data.data).hexdigest() != self._sha256:
            raise InputLostError("its bytes are not those that were accepted")
        return data


class JobFiles:
    """The folder of inputs and results.

    Args:
        folder: made, private to this user, where it is not there.
        writer: name of this process, which its unfinished files carry.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        self._writer = writer
        self._folder = folder
        self._parts = folder / "parts"
        self._inputs = folder / "inputs"
        self._results = folder / "results"

    def prepare(self) -> None:
        """Make the folders.

        Raises:
            OSError: they cannot be made, or not be written to.
        """
        _make_private(self._folder)
        for folder in (self._parts, self._inputs, self._results):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Whether a file can be made, only making one tells.
        probe = self._parts / f"{self._writer}.probe"
        probe.touch()
        probe.unlink()

    def new_input(self, job_id: str) -> NewFile:
        """Begin the input of a job."""
        return NewFile(self._parts / f"{self._writer}.{job_id}.in", self._inputs / job_id)

    def new_result(self, job_id: str) -> NewFile:
        """Begin the result of a job."""
        return NewFile(self._parts / f"{self._writer}.{job_id}.out", self._results / job_id)

    def input(self, job_id: str, size: int, sha256: str) -> StoredInput:
        """Return the input of a job."""
        return StoredInput(self._inputs / job_id, size, sha256)

    def result(self, job_id: str) -> Path:
        """Return where the result of a job is, if it is."""
        return self._results / job_id

    def remove_input(self, job_id: str) -> None:
        """Remove the input of a job, if it is there."""
        _remove(self._inputs / job_id)

    def remove_result(self, job_id: str) -> None:
        """Remove the result of a job, if it is there."""
        _remove(self._results / job_id)

    def sweep(
        self,
        inputs: set[str],
        results: set[str],
        youngest: float,
        alive: Callable[[str], bool],
    ) -> int:
        """Remove what no job needs; return how many files that were.

        Args:
            inputs: ids whose inputs stay.
            results: ids whose results stay.
            youngest: inputs and results made after that stay, seconds since 1970. It must lie
                before the moment at which the ids were read.
            alive: whether the process of a name still runs.
        """
        removed = 0
        for folder, kept in ((self._inputs, inputs), (self._results, results)):
            for path in folder.iterdir():
                if path.name not in kept and _modified(path) <= youngest:
                    removed += _remove(path)
        for path in self._parts.iterdir():
            writer = path.name.partition(".")[0]
            if not alive(writer):
                removed += _remove(path)
        return removed


def _make_private(folder: Path) -> None:
    """Make a folder; refuse one that another user left where everybody may leave things."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    shared = folder.parent.stat().st_mode & stat.S_ISVTX
    if shared and (folder.is_symlink() or folder.stat().st_uid != os.geteuid()):
        raise PermissionError(errno.EPERM, "it belongs to another user", str(folder))


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def _sync_folder(folder: Path) -> None:
    """Put a new name on the disk; the bytes of a file alone would be found by nobody."""
    with _opened(folder) as descriptor:
        os.fsync(descriptor)


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int]:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
