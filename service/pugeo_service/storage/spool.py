# SPDX-License-Identifier: Apache-2.0
"""Bytes on their way in or out, in memory or in an unnamed file."""

import asyncio
import os
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path
from tempfile import SpooledTemporaryFile
from types import TracebackType
from typing import IO, Self

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.shared_file import NOWHERE, SharedFile, shared_file

__all__ = ["Sink", "Spool"]

_IN_MEMORY = 1 << 20


class Sink(ABC):
    """Takes bytes as they come and hands them on a MiB at a time, in a thread.

    Attributes:
        size: bytes taken.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self.size = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    async def write(self, data: bytes | memoryview) -> None:
        """Append bytes."""
        self.size += len(data)
        self._pending += data
        # One thread hop for each MiB and not for each 64 KiB that the network delivers.
        if len(self._pending) >= _IN_MEMORY:
            await self.flush()

    def close(self) -> None:
        """Give back what is held; twice is once."""
        self._pending = bytearray()

    async def flush(self) -> None:
        """Put what is held back where it belongs."""
        if self._pending:
            data, self._pending = self._pending, bytearray()
            await asyncio.to_thread(self._store, data)

    @abstractmethod
    def _store(self, data: bytearray) -> None:
        """Put bytes where they belong; runs in a thread."""


class Spool(Sink):
    """A write-once, read-many buffer: up to 1 MiB in memory, unless it is shared.

    The file has no name, so it vanishes with the process whatever happens. Once the bytes are
    on disk, every access runs in a thread: a slow disk must not stop the event loop.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._file: IO[bytes] = SpooledTemporaryFile(max_size=_IN_MEMORY, dir=str(folder))  # noqa: SIM115
        self._start = 0

    async def share(self) -> SharedFile:
        """Let other processes write into a file, before anything is written here; see `take`.

        A disk that has no room for one is no error yet: a small answer needs none.
        """
        sharing = asyncio.create_task(asyncio.to_thread(self._share))
        try:
            return await asyncio.shield(sharing)
        finally:
            # Whoever gives up closes the file next, which must be there by then.
            await asyncio.wait({sharing})

    async def take(self, data: bytes | int) -> int:
        """Append bytes, or as many as another process has put behind the last; return how many."""
        if not isinstance(data, int):
            await self.write(data)
            return len(data)
        await self.flush()
        self._file.seek(data, os.SEEK_CUR)
        self.size += data
        return data

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``, as one buffer in memory."""
        await self.flush()
        return await asyncio.to_thread(self._read_all)

    async def chunks(self, size: int = _IN_MEMORY) -> AsyncIterator[bytes]:
        """Yield all bytes in order, ``size`` at a time."""
        await self.flush()
        await asyncio.to_thread(self._file.seek, self._start)
        left = self.size
        while data := await asyncio.to_thread(self._file.read, min(size, left)):
            left -= len(data)
            yield data

    def close(self) -> None:
        """Give the memory and the disk back."""
        super().close()
        # What a full disk did not take is tried once more; nobody wants it any longer.
        with suppress(OSError):
            self._file.close()

    def _store(self, data: bytearray) -> None:
        self._file.write(data)
        # To the disk, which may be full, and not to a buffer that is written out some time.
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
