# SPDX-License-Identifier: Apache-2.0
"""Bytes on their way in or out: small ones in memory, large ones in an unnamed file."""

import asyncio
import os
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator
from pathlib import Path
from tempfile import SpooledTemporaryFile
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pugeo_service.shared_file import SharedFile

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
    """A write-once, read-many buffer that keeps at most 1 MiB in memory.

    The file has no name, so it vanishes with the process whatever happens. Once the bytes are
    on disk, every access runs in a thread: a slow disk must not stop the event loop.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._file = SpooledTemporaryFile(max_size=_IN_MEMORY, dir=str(folder))  # noqa: SIM115
        self._start = 0

    async def share(self) -> SharedFile:
        """Let other processes write into the file, which has to be empty, see `take`."""
        return await asyncio.to_thread(self._share)

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
        while data := await asyncio.to_thread(self._file.read, size):
            yield data

    def close(self) -> None:
        """Give the memory and the disk back."""
        super().close()
        self._file.close()

    def _store(self, data: bytearray) -> None:
        self._file.write(data)

    def _share(self) -> SharedFile:
        self._file.rollover()
        shared = SharedFile.of(self._file.fileno())
        self._start = self._file.seek(shared.start)
        return shared

    def _read_all(self) -> NDArray[np.uint8]:
        self._file.seek(self._start)
        return np.frombuffer(self._file.read(), np.uint8)
