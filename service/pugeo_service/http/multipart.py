# SPDX-License-Identifier: Apache-2.0
"""The part ``file`` of a multipart body, as a stream."""

from collections.abc import AsyncIterator

from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header

from pugeo_service.problems import ProblemError

__all__ = ["FilePart"]

_NAME = "file"


class FilePart:
    """Finds the one part named ``file`` in a multipart body.

    Starlette's own form parser would do, but it spools to the system's folder for temporary
    files, keeps parts that nobody asked for, and takes a body that ends in the middle.

    Args:
        content_type: the request's ``Content-Type`` with its boundary.

    Attributes:
        content_type: the part's own ``Content-Type`` once its headers are read, or ``""``.

    Raises:
        ProblemError: 400 for a boundary that is missing or too long.
    """

    def __init__(self, content_type: str) -> None:
        _, options = parse_options_header(content_type)
        boundary = options.get(b"boundary")
        if not boundary:
            raise ProblemError(400, "malformed_multipart", "The multipart body has no boundary.")
        self.content_type = ""
        self._header_name = b""
        self._header_value = b""
        self._headers: dict[bytes, bytes] = {}
        self._seen = False
        self._ended = False
        self._data: list[bytes] = []
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_part_begin": self._headers.clear,
                    "on_header_field": self._on_header_field,
                    "on_header_value": self._on_header_value,
                    "on_header_end": self._on_header_end,
                    "on_headers_finished": self._on_headers_finished,
                    "on_part_data": self._on_part_data,
                    "on_end": self._on_end,
                },
            )
        except FormParserError as error:
            detail = "The boundary of the multipart body is longer than the 256 bytes allowed."
            raise ProblemError(400, "malformed_multipart", detail) from error

    async def data(self, body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Yield the bytes of the part ``file`` from the bytes of the whole body.

        Raises:
            ProblemError: 400 for a body that is not multipart, has no such part, or other parts.
        """
        try:
            async for chunk in body:
                self._parser.write(chunk)
                for piece in self._data:
                    yield piece
                self._data.clear()
        except FormParserError as error:
            detail = "The body is not the multipart form that its Content-Type promises."
            raise ProblemError(400, "malformed_multipart", detail) from error
        if not self._ended:
            raise ProblemError(400, "malformed_multipart", "The multipart body ends in the middle.")
        if not self._seen:
            raise ProblemError(
                400, "missing_file", f"The multipart body has no part named {_NAME!r}."
            )

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header_name += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._header_value += data[start:end]

    def _on_header_end(self) -> None:
        self._headers[self._header_name.lower()] = self._header_value
        self._header_name = self._header_value = b""

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._headers.get(b"content-disposition", b""))
        name = options.get(b"name", b"").decode("latin-1")
        if name != _NAME or self._seen:
            detail = (
                f"The multipart body has the part {name[:40]!r}; it takes one part named "
                f"{_NAME!r}, and options belong in the query, such as /upsample?R=8."
            )
            raise ProblemError(400, "unexpected_part", detail, fields={"part": name[:80]})
        self._seen = True
        self.content_type = self._headers.get(b"content-type", b"").decode("latin-1")

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._data.append(data[start:end])

    def _on_end(self) -> None:
        self._ended = True
