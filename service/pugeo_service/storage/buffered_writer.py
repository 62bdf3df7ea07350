# SPDX-License-Identifier: Apache-2.0
"""Base class of destinations for bytes that arrive in small pieces."""

import asyncio
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

__all__ = ["BUFFER_BYTES", "BufferedWriter"]

BUFFER_BYTES = 1 << 20


class BufferedWriter(ABC):
    """Collects bytes and stores them 1 MiB at a time, in a thread.

    Attributes:
        size: bytes received.
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
        # One switch to a thread per MiB instead of one per 64 KiB from the network.
        if len(self._pending) >= BUFFER_BYTES:
            await self.flush()

    def close(self) -> None:
        """Close. Idempotent."""
        self._pending = bytearray()

    async def flush(self) -> None:
        """Store the buffered bytes."""
        if self._pending:
            data, self._pending = self._pending, bytearray()
            await asyncio.to_thread(self._store, data)

    @abstractmethod
    def _store(self, data: bytearray) -> None:
        """Store bytes; called in a thread."""
