# SPDX-License-Identifier: Apache-2.0
"""Reception of bodies: media types, limits, slow and departed clients."""

import asyncio
from pathlib import Path

import pytest
from starlette.requests import Request
from starlette.types import Message

from pugeo_service.admission.admission import Admission
from pugeo_service.http.body import ClientDisconnectedError, receive_body
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings

LIMIT = 1000


class Wire:
    """A connection that delivers messages and then stalls."""

    def __init__(self, *pieces: bytes | None) -> None:
        self.left: list[Message] = [
            {"type": "http.disconnect"}
            if piece is None
            else {"type": "http.request", "body": piece, "more_body": index < len(pieces) - 1}
            for index, piece in enumerate(pieces)
        ]

    async def receive(self) -> Message:
        if not self.left:
            await asyncio.Event().wait()
        return self.left.pop(0)


def take(
    wire: Wire, tmp_path: Path, admission: Admission | None = None, **headers: str
) -> tuple[bytes, str | None]:
    """Receive a body; return its bytes and format."""
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    request = Request({"type": "http", "headers": raw}, wire.receive)
    settings = Settings(max_body_bytes=LIMIT, body_idle_s=0.05, spool_dir=tmp_path)

    async def run() -> tuple[bytes, str | None]:
        with (admission or Admission(9, 10_000, 9)).reserve() as reservation:
            body = await receive_body(request, settings, reservation)
            with body.spool as spool:
                return (await spool.read()).tobytes(), body.format

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("content_type", "expected"),
    [
        ("", None),
        ("application/octet-stream", None),
        ("application/x-www-form-urlencoded", None),
        ("text/plain; charset=utf-8", None),
        ("application/x-ply", "ply"),
        ("Application/JSON; charset=utf-8", "json"),
        ("application/x-npy", "npy"),
        ("application/x-npz", "npz"),
        ("text/csv", "xyz"),
    ],
)
def test_types(tmp_path: Path, content_type: str, expected: str | None) -> None:
    """A specific type decides the format; an unspecific one leaves that to the content."""
    wire = Wire(b"ab", b"", b"c")
    assert take(wire, tmp_path, content_type=content_type) == (b"abc", expected)


@pytest.mark.parametrize(
    ("pieces", "content_type", "expected"),
    [
        ((b"pl", b"y\nformat ascii 1.0\n"), "", "ply-ascii"),
        ((b"ply\nformat ascii 1.0\n",), "application/x-ply", "ply-ascii"),
        ((b"PK\x03\x04" + bytes(8000),), "application/zip", "npz"),
        ((b"\x00\x01",), "application/x-ply", "ply"),
        ((b"\x00\x01",), "", None),
    ],
)
def test_the_format_of_the_content(
    tmp_path: Path, pieces: tuple[bytes, ...], content_type: str, expected: str | None
) -> None:
    """The first bytes tell the format, however they arrive; else the declared type does."""
    settings = Settings(spool_dir=tmp_path)
    scope = {"type": "http", "headers": [(b"content-type", content_type.encode())]}

    async def run() -> str | None:
        with Admission(9, 10_000, 9).reserve() as reservation:
            request = Request(scope, Wire(*pieces).receive)
            body = await receive_body(request, settings, reservation)
            body.spool.close()
            return body.read_as

    assert asyncio.run(run()) == expected


@pytest.mark.parametrize("content_type", ["image/png", "text/html", "application/xml", "x"])
def test_other_types(tmp_path: Path, content_type: str) -> None:
    """415 lists the accepted types before a byte is read."""
    wire = Wire(b"abc")
    with pytest.raises(ProblemError) as caught:
        take(wire, tmp_path, content_type=content_type)
    assert (caught.value.status, caught.value.code) == (415, "unsupported_media_type")
    assert "application/json" in caught.value.fields["accepted"]
    assert len(wire.left) == 1


def test_compressed_bodies(tmp_path: Path) -> None:
    """A compressed body is refused, because its size is unknown."""
    with pytest.raises(ProblemError) as caught:
        take(Wire(b"abc"), tmp_path, content_encoding="gzip")
    assert (caught.value.status, caught.value.code) == (415, "unsupported_encoding")
    assert caught.value.headers["Accept-Encoding"] == "identity"


def test_an_announced_size_is_refused_at_once(tmp_path: Path) -> None:
    """A body whose Content-Length is too large is not read."""
    wire = Wire(b"abc")
    with pytest.raises(ProblemError) as caught:
        take(wire, tmp_path, content_length=str(LIMIT + 1))
    assert (caught.value.status, caught.value.code) == (413, "body_too_large")
    setting = "PUGEO_MAX_BODY_BYTES"
    assert caught.value.fields == {"limit": LIMIT, "value": LIMIT + 1, "setting": setting}
    assert setting in caught.value.detail
    assert len(wire.left) == 1


def test_an_unannounced_size_is_refused_as_it_arrives(tmp_path: Path) -> None:
    """A body without Content-Length is refused at the limit."""
    wire = Wire(b"x" * 600, b"x" * 600, b"x" * 600)
    with pytest.raises(ProblemError, match="limit"):
        take(wire, tmp_path)
    assert len(wire.left) == 1


def test_the_limit_itself_fits(tmp_path: Path) -> None:
    """A body of exactly the limit is accepted."""
    assert take(Wire(b"x" * LIMIT), tmp_path, content_length=str(LIMIT))[0] == b"x" * LIMIT


def test_an_empty_body(tmp_path: Path) -> None:
    """An empty body is a 400."""
    with pytest.raises(ProblemError) as caught:
        take(Wire(b""), tmp_path)
    assert (caught.value.status, caught.value.code) == (400, "empty_body")


def test_an_empty_part(tmp_path: Path) -> None:
    """An empty file of a form is a 400."""
    body = b'--B\r\nContent-Disposition: form-data; name="file"\r\n\r\n\r\n--B--\r\n'
    with pytest.raises(ProblemError, match="empty"):
        take(Wire(body), tmp_path, content_type="multipart/form-data; boundary=B")


def test_a_part_of_unknown_type(tmp_path: Path) -> None:
    """An unknown type of a part is ignored, because browsers guess it."""
    head = b'--B\r\nContent-Disposition: form-data; name="file"\r\nContent-Type: image/ply\r\n\r\n'
    found = take(
        Wire(head + b"xyz\r\n--B--\r\n"),
        tmp_path,
        content_type="multipart/form-data; boundary=B",
    )
    assert found == (b"xyz", None)


def test_a_client_that_leaves(tmp_path: Path) -> None:
    """A disconnect during the body is not a problem document."""
    with pytest.raises(ClientDisconnectedError):
        take(Wire(b"abc", None), tmp_path)


def test_a_client_that_stalls(tmp_path: Path) -> None:
    """A silent connection is answered with 408."""
    wire = Wire(b"abc", b"")
    wire.left.pop()
    with pytest.raises(ProblemError) as caught:
        take(wire, tmp_path)
    assert (caught.value.status, caught.value.retryable) == (408, True)


def test_what_was_held_is_given_back(tmp_path: Path) -> None:
    """A refused body releases its reserved bytes."""
    admission = Admission(9, 10_000, 9)
    with pytest.raises(ProblemError, match="limit"):
        take(Wire(b"x" * 600, b"x" * 600), tmp_path, admission)
    assert admission.bytes == 0
