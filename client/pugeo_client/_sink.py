# SPDX-License-Identifier: Apache-2.0
"""Where an answer goes: memory, or a file that appears when it is complete."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pugeo_client._atomic import atomic_file
from pugeo_client._result import Result
from pugeo_client._wire import meta_of

__all__ = ["Sink"]


class Sink:
    """Collects the answer of one call; `open` starts over at each try.

    Args:
        format: name of the answer's format.
        out: file to write, or None for memory.
    """

    def __init__(self, *, format: str, out: Path | None) -> None:
        self.format = format
        self.out = out
        self._parts: list[bytes] = []
        self._file: BinaryIO | None = None

    @contextmanager
    def open(self) -> Iterator[None]:
        """Take an answer; a file is in place once the block has ended well."""
        self._parts = []
        if self.out is None:
            yield
        else:
            with atomic_file(self.out) as self._file:
                yield

    def write(self, chunk: bytes) -> None:
        """Take the next bytes."""
        if self._file is None:
            self._parts.append(chunk)
        else:
            self._file.write(chunk)

    def result(self, headers: Mapping[str, str]) -> Result:
        """Wrap what was taken."""
        data = b"".join(self._parts) if self.out is None else None
        return Result(meta_of(headers), format=self.format, data=data, path=self.out)
