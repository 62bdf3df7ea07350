# SPDX-License-Identifier: Apache-2.0
"""Atomic and durable writing of a file."""

import asyncio
import contextlib
import hashlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from pugeo_service.storage.buffered_writer import BufferedWriter

__all__ = ["AtomicFile"]


class AtomicFile(BufferedWriter):
    """A file that appears under its name once it is complete and on disk.

    Args:
        part: path while it is written.
        target: path of the complete file.
    """

    def __init__(self, part: Path, target: Path) -> None:
        super().__init__()
        self._part = part
        self._target = target
        self._file: BinaryIO | None = None
        self._sha256 = hashlib.sha256()
        # After a cancellation a thread may still be storing. It must not open a new file, and the
        # event loop must not wait for it: the last of the two removes the file.
        self._busy = threading.Lock()
        self._closed = False

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes in hexadecimal, once the file is committed."""
        return self._sha256.hexdigest()

    async def commit(self) -> None:
        """Make the file appear under its name; afterwards it survives a power cut.

        Raises:
            OSError: the disk is full or fails; `close` removes the part.
        """
        await self.flush()
        await asyncio.to_thread(self._publish)

    def close(self) -> None:
        """Remove the part unless the file is committed. Idempotent."""
        super().close()
        self._closed = True
        self._remove_part()

    def _store(self, data: bytearray) -> None:
        with self._opened() as file:
            if file is not None:
                self._sha256.update(data)
                file.write(data)

    def _publish(self) -> None:
        with self._opened() as file:
            if file is not None:
                file.flush()
                os.fsync(file.fileno())
                file.close()
                self._file = None
                self._part.replace(self._target)
                _sync_folder(self._target.parent)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BinaryIO | None]:
        """Yield the open file to the thread that stores; ``None`` after `close`."""
        try:
            with self._busy:
                if self._file is None and not self._closed:
                    descriptor = os.open(self._part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                    self._file = os.fdopen(descriptor, "wb")
                yield None if self._closed else self._file
        finally:
            if self._closed:
                self._remove_part()

    def _remove_part(self) -> None:
        """Close and remove the part, unless a thread is storing; that thread then does it."""
        if not self._busy.acquire(blocking=False):
            return
        try:
            if self._file is not None:
                # A full disk may refuse the buffered bytes, which are not needed any more.
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None
            self._part.unlink(missing_ok=True)
        finally:
            self._busy.release()


def _sync_folder(folder: Path) -> None:
    """Write the entry of a new file to disk; fsync of the file alone does not include it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:  # Windows opens no folders; its file system keeps a journal
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
