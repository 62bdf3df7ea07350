# SPDX-License-Identifier: Apache-2.0
"""Inputs and results of jobs in a store, so that fronts on several machines share no folder.

The store holds what is complete: a file is written to a local folder first, then stored, and only
then does the row of its job name it. The local folder is a cache. What comes from the store is
compared with the digest of the row before it is used or served.
"""

import asyncio
import functools
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from pugeo_service.jobs.files import InputLostError, JobFiles, ResultLostError, StoredInput
from pugeo_service.storage.atomic_file import AtomicFile
from pugeo_service.storage.object_store import ObjectStore, StoreError

__all__ = ["StoredJobFiles"]

_log = structlog.stdlib.get_logger("pugeo.jobs")
# Other fronts may be storing files of jobs that have no row yet, and copies here may be in use.
_YOUNG_S = 3600.0


class _StoredFile(AtomicFile):
    """A file that is stored once it is complete.

    Args:
        part: path while it is written.
        target: path of the complete file.
        store: called with this file in a thread; stores it.
    """

    def __init__(self, part: Path, target: Path, store: Callable[["_StoredFile"], None]) -> None:
        super().__init__(part, target)
        self._store_complete = store
        self._complete = target

    async def commit(self) -> None:
        """Make the file complete, and store it.

        Raises:
            StoreError: it is not stored; the local copy is removed.
            OSError: the disk is full or fails.
        """
        await super().commit()
        try:
            await asyncio.to_thread(self._store_complete, self)
        except BaseException:
            self._complete.unlink(missing_ok=True)
            raise


class _FetchedInput(StoredInput):
    """The input of a job, fetched from the store unless it is here."""

    def __init__(self, path: Path, size: int, sha256: str, fetch: Callable[[], None]) -> None:
        super().__init__(path, size, sha256)
        self._fetch = fetch

    def _read(self) -> NDArray[np.uint8]:
        with suppress(InputLostError):
            return super()._read()
        try:
            self._fetch()
        except FileNotFoundError as error:
            raise InputLostError("the file is missing") from error
        return super()._read()


class StoredJobFiles(JobFiles):
    """Inputs and results in a store.

    Args:
        folder: for copies and incomplete files.
        writer: name of this process.
        url: of the store.
    """

    def __init__(self, folder: Path, writer: str, url: str) -> None:
        super().__init__(folder, writer)
        self._url = url
        self._opened: ObjectStore | None = None

    def prepare(self) -> None:
        """Create the local folders, and test the store with a write.

        Raises:
            OSError: a folder or the store cannot be written.
        """
        super().prepare()
        probe, key = self._parts / f"{self._writer}.probe", f"parts/{self._writer}"
        probe.write_bytes(b"probe")
        try:
            self._objects.put(probe, key)
            self._objects.remove(key)
        finally:
            probe.unlink()

    def new_input(self, job_id: str) -> AtomicFile:
        """Start writing the input of a job."""
        path = self._inputs / job_id
        return _StoredFile(
            self._parts / f"{self._writer}.{job_id}.in",
            path,
            lambda _: self._objects.put(path, f"inputs/{job_id}"),
        )

    def new_result(self, job_id: str) -> AtomicFile:
        """Start writing the result of a job."""
        path = self._results / job_id
        return _StoredFile(
            self._parts / f"{self._writer}.{job_id}.out",
            path,
            lambda file: self._objects.put(path, _result_key(job_id, file.sha256)),
        )

    def input(self, job_id: str, size: int, sha256: str) -> StoredInput:
        """Return the input of a job."""
        path = self._inputs / job_id
        fetch = functools.partial(self._fetch, f"inputs/{job_id}", path)
        return _FetchedInput(path, size, sha256, fetch)

    def result(self, job_id: str, size: int, sha256: str) -> Path:
        """Return the path of a copy of the result of a job; fetch it unless it is here.

        Raises:
            FileNotFoundError: there is no such result.
            ResultLostError: its bytes have changed.
            StoreError: the store cannot be read.
        """
        with suppress(FileNotFoundError, ResultLostError):
            return super().result(job_id, size, sha256)
        self._fetch(_result_key(job_id, sha256), self._results / job_id)
        return super().result(job_id, size, sha256)

    def remove_input(self, job_id: str) -> None:
        """Remove the input of a job, if it exists; if the store fails, `sweep` removes it later."""
        super().remove_input(job_id)
        self._remove(f"inputs/{job_id}")

    def remove_result(self, job_id: str) -> None:
        """Remove the result of a job; if the store fails, `sweep` removes it later."""
        super().remove_result(job_id)
        self._remove(f"results/{job_id}")

    def sweep(
        self,
        inputs: set[str],
        results: set[str],
        made_before: float,
        is_alive: Callable[[str], bool],
    ) -> int:
        """Remove files that no job needs from the store, and older copies from here."""
        # Other processes may use the same store, so recent files are kept.
        made_before = min(made_before, time.time() - _YOUNG_S)
        removed = super().sweep(set(), set(), made_before, is_alive)
        for folder, kept in (("inputs", inputs), ("results", results)):
            for name in self._objects.old(folder, kept, made_before):
                self._objects.remove(f"{folder}/{name}")
                removed += 1
        return removed

    @property
    def _objects(self) -> ObjectStore:
        # Opened late: a store that cannot be reached must not keep the service from starting.
        if self._opened is None:
            self._opened = ObjectStore(self._url)
        return self._opened

    def _fetch(self, key: str, path: Path) -> None:
        """Copy a stored file to a path, at which it appears whole.

        Raises:
            FileNotFoundError, StoreError: see `ObjectStore.get`.
        """
        part = self._parts / f"{self._writer}.{path.name}.{time.monotonic_ns()}.get"
        try:
            self._objects.get(key, part)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def _remove(self, key: str) -> None:
        try:
            self._objects.remove(key)
        except StoreError as error:
            _log.warning("a file stays in the store until the next sweep", reason=str(error))


def _result_key(job_id: str, sha256: str) -> str:
    """Return the key of a result.

    It has the digest, so that a process that lost its job to another one, and comes late with
    other bytes, does not replace the result that the row names.
    """
    return f"results/{job_id}/{sha256}"
