# SPDX-License-Identifier: Apache-2.0
"""Temporary storage of a body or an answer, in memory or in an unnamed file."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.buffered_writer import BUFFER_BYTES, BufferedWriter
from pugeo_service.storage.shared_file import NOWHERE, SharedFile, shared_file

__all__ = ["Spool"]


class Spool(BufferedWriter):
    """A write-once, read-many buffer: up to 1 MiB in memory, unless it is shared.

    The file has no name, so the system removes it with the process. Every access to the disk runs
    in a thread, because a slow disk must not block the event loop.

    Args:
        folder: for the file.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._file: IO[bytes] = SpooledTemporaryFile(max_size=BUFFER_BYTES, dir=str(folder))  # noqa: SIM115
        self._start = 0

    async def share(self) -> SharedFile:
        """Let other processes write into the file; call it before anything is written.

        If the file cannot be made, the result refers to no file; a small answer needs none.
        """
        sharing = asyncio.create_task(asyncio.to_thread(self._share))
        try:
            return await asyncio.shield(sharing)
        finally:
            # After a cancellation the caller closes the file, which must exist by then.
            await asyncio.wait({sharing})

    async def take(self, data: bytes | int) -> int:
        """Append bytes, or count the bytes that another process has appended; return the number."""
        if not isinstance(data, int):
            await self.write(data)
            return len(data)
        await self.flush()
        self._file.seek(data, os.SEEK_CUR)
        self.size += data
        return data

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``."""
        await self.flush()
        return await asyncio.to_thread(self._read_all)

    async def chunks(self, size: int = BUFFER_BYTES) -> AsyncIterator[bytes]:
        """Yield all bytes in order, ``size`` at a time."""
        await self.flush()
        await asyncio.to_thread(self._file.seek, self._start)
        left = self.size
        while data := await asyncio.to_thread(self._file.read, min(size, left)):
            left -= len(data)
            yield data

    def close(self) -> None:
        """Close and delete the file. Idempotent."""
        super().close()
        # Closing writes buffered bytes again, which a full disk refuses again.
        with suppress(OSError):
            self._file.close()

    def _store(self, data: bytearray) -> None:
        self._file.write(data)
        # At once, so that a full disk raises here and not at a later write.
        self._file.flush()

    def _share(self) -> SharedFile:
        try:
            file, shared = shared_file(self._folder)
        except OSError:
            return NOWHERE
        self._file.close()
        self._file, self._start = file, shared.start
        return shared

    def _read_all(self) -> NDArray[np.uint8]:
        self._file.seek(self._start)
        return np.frombuffer(self._file.read(self.size), np.uint8)
