# SPDX-License-Identifier: Apache-2.0
"""Receivers of an answer: a cloud to memory or to a file, or a JSON document."""

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Generic, Protocol, TypeVar

from pugeo_client._atomic import atomic_file, check_writable
from pugeo_client._responses import meta_from_headers, parse_object
from pugeo_client._result import Result
from pugeo_client._verify import verify_cloud
from pugeo_client.errors import InvalidResponseError

__all__ = ["CloudReceiver", "DocumentReceiver", "Receiver"]

MAX_DOCUMENT_BYTES = 16 << 20

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Receiver(Protocol[T_co]):
    """Destination of the answer of one call; each attempt opens it again.

    Attributes:
        reports_progress: whether the bytes are worth a call of ``on_progress``.
    """

    reports_progress: bool

    def open(self) -> AbstractContextManager[None]:
        """Begin to receive; an error inside of the block discards what came."""

    def write(self, chunk: bytes) -> None:
        """Take the next bytes."""

    def check(self, headers: Mapping[str, str]) -> None:
        """Raise InvalidResponseError unless the answer is complete and of its format."""

    def result(self, headers: Mapping[str, str]) -> T_co:
        """Return the answer."""


class CloudReceiver:
    """Receives a dense cloud.

    Args:
        format: of the answer, such as ``"ply"``.
        out: output file, or None for memory. It is replaced only by a complete cloud.

    Raises:
        OSError: ``out`` cannot be written.
    """

    def __init__(self, *, format: str, out: Path | None) -> None:
        if out is not None:
            check_writable(out)
        self.reports_progress = True
        self._format = format
        self._out = out
        self._file: BinaryIO = io.BytesIO()

    @contextmanager
    def open(self) -> Iterator[None]:
        """Begin to receive; the output file is in place after the block."""
        if self._out is None:
            self._file = io.BytesIO()
            yield
        else:
            with atomic_file(self._out) as self._file:
                yield

    def write(self, chunk: bytes) -> None:
        """Take the next bytes."""
        self._file.write(chunk)

    def check(self, headers: Mapping[str, str]) -> None:
        """Raise InvalidResponseError unless a complete cloud of the promised size came."""
        verify_cloud(self._file, self._format, meta_from_headers(headers).points_out)

    def result(self, headers: Mapping[str, str]) -> Result:
        """Return the cloud with its description."""
        data = self._file.getvalue() if isinstance(self._file, io.BytesIO) else None
        return Result(meta_from_headers(headers), format=self._format, data=data, path=self._out)


class DocumentReceiver(Generic[T]):
    """Receives a JSON object of limited size.

    Args:
        read: makes the result of it; raises InvalidResponseError for one of another form.
    """

    def __init__(self, read: Callable[[dict[str, Any]], T]) -> None:
        self.reports_progress = False
        self._read = read
        self._body = bytearray()

    @contextmanager
    def open(self) -> Iterator[None]:
        """Begin to receive."""
        self._body.clear()
        yield

    def write(self, chunk: bytes) -> None:
        """Take the next bytes."""
        self._body += chunk
        if len(self._body) > MAX_DOCUMENT_BYTES:
            raise InvalidResponseError(f"the answer is longer than {MAX_DOCUMENT_BYTES >> 20} MiB")

    def check(self, headers: Mapping[str, str]) -> None:
        """Do nothing: `result` checks the document."""

    def result(self, headers: Mapping[str, str]) -> T:  # noqa: ARG002 - as in `Receiver`
        """Return what ``read`` makes of the document."""
        return self._read(parse_object(bytes(self._body)))
