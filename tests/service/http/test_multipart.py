# SPDX-License-Identifier: Apache-2.0
"""The part ``file`` comes out whole, however the body was cut up on its way."""

import asyncio
from collections.abc import AsyncIterator

import pytest

from pugeo_service.http.multipart import FilePart
from pugeo_service.problems import ProblemError

TYPE = "multipart/form-data; boundary=XYZ"
HEAD = b'--XYZ\r\nContent-Disposition: form-data; name="file"; filename="a.ply"\r\n'
DATA = b"ply\r\n--XY not the boundary\r\n--" * 50


def extract(body: bytes, step: int, content_type: str = TYPE) -> tuple[bytes, str]:
    """Feed a body in pieces of ``step`` bytes; return the part and its type."""

    async def pieces() -> AsyncIterator[bytes]:
        for start in range(0, len(body), step):
            yield body[start : start + step]

    async def collect() -> tuple[bytes, str]:
        part = FilePart(content_type)
        data = b"".join([piece async for piece in part.data(pieces())])
        return data, part.content_type

    return asyncio.run(collect())


@pytest.mark.parametrize("step", [1, 7, 64, 10_000])
def test_the_bytes_survive(step: int) -> None:
    """No cut, not even within the boundary, loses or adds a byte."""
    body = HEAD + b"Content-Type: model/ply\r\n\r\n" + DATA + b"\r\n--XYZ--\r\n"
    assert extract(body, step) == (DATA, "model/ply")


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (HEAD + b"\r\n" + DATA, "malformed_multipart"),
        (b"not multipart at all", "malformed_multipart"),
        (b"--XYZ--\r\n", "missing_file"),
        (
            b'--XYZ\r\nContent-Disposition: form-data; name="R"\r\n\r\n8\r\n--XYZ--\r\n',
            "unexpected_part",
        ),
        (
            HEAD + b"\r\n1\r\n" + HEAD + b"\r\n2\r\n--XYZ--\r\n",
            "unexpected_part",
        ),
        (b"--XYZ\r\n\r\nno name\r\n--XYZ--\r\n", "unexpected_part"),
    ],
)
def test_what_is_wrong(body: bytes, code: str) -> None:
    """A body cut short, of another kind, without the part, or with others, is a 400."""
    with pytest.raises(ProblemError) as caught:
        extract(body, 16)
    assert (caught.value.status, caught.value.code) == (400, code)


def test_options_in_the_form_are_explained() -> None:
    """Whoever sends R as a field is told where it belongs."""
    body = b'--XYZ\r\nContent-Disposition: form-data; name="R"\r\n\r\n8\r\n--XYZ--\r\n'
    with pytest.raises(ProblemError, match="query"):
        extract(body, 1000)


def test_no_boundary() -> None:
    """A type without a boundary cannot be read."""
    with pytest.raises(ProblemError, match="boundary"):
        extract(b"", 1, "multipart/form-data")


def test_a_boundary_too_long() -> None:
    """It is the client's mistake, and no error of the service."""
    with pytest.raises(ProblemError, match="longer than the 256 bytes") as caught:
        FilePart("multipart/form-data; boundary=" + "b" * 257)
    assert (caught.value.status, caught.value.code) == (400, "malformed_multipart")
