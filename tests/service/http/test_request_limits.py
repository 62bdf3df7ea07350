# SPDX-License-Identifier: Apache-2.0
"""Heads are bounded in bytes, fields and seconds, on a real server."""

import json
import logging
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from pugeo_service.http import request_limits
from pugeo_service.http.request_limits import BoundedHeads

LINE = b"POST / HTTP/1.1\r\nHost: x\r\n"
CHUNKED = LINE + b"Transfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n"


async def echo(_scope: Scope, receive: Receive, send: Send) -> None:
    """Answer with the number of bytes of the body."""
    size, more = 0, True
    while more:
        message = await receive()
        size += len(message.get("body", b""))
        more = message.get("more_body", False)
    body = b"%d bytes" % size
    headers = [(b"content-length", b"%d" % len(body))]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """The port of a server with our protocol."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        echo, http=BoundedHeads, ws="none", lifespan="off", log_config=None, access_log=False
    )
    server = uvicorn.Server(config)
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    yield listener.getsockname()[1]
    server.should_exit = True
    thread.join(20)
    listener.close()
    logging.getLogger("uvicorn.error").setLevel(logging.NOTSET)


def talk(port: int, *pieces: bytes, pause: float = 0.0) -> bytes:
    """Send pieces and read until the server hangs up or answers whole."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        try:
            for piece in pieces:
                connection.sendall(piece)
                time.sleep(pause)
        except ConnectionError:
            # It hung up in the middle, as it should; what it said before is still there.
            pass
        answer = b""
        try:
            while piece := connection.recv(1 << 16):
                answer += piece
                if answer.endswith(b"bytes"):
                    break
        except ConnectionError:
            # So do bytes that nobody read on the other side: they may take the answer along.
            pass
        return answer


def problem(answer: bytes) -> dict[str, Any]:
    """The body of an answer, which must be a problem on a connection that ends."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head
    assert b"connection: close" in head.lower()
    assert b"nosniff" in head
    found: dict[str, Any] = json.loads(body)
    assert head.startswith(b"HTTP/1.1 %d " % found["status"])
    return found


def test_good_requests_pass(port: int) -> None:
    """A head of usual size, byte by byte, with a body, with fields after a body, twice in a row."""
    plain = LINE + b"Content-Length: 5\r\n\r\nhello"
    assert talk(port, plain).endswith(b"5 bytes")
    assert talk(port, *(bytes([byte]) for byte in plain)).endswith(b"5 bytes")
    assert talk(port, CHUNKED + b"A: b\r\n\r\n").endswith(b"5 bytes")
    cookies = b"".join(b"X-%d: %s\r\n" % (number, b"v" * 500) for number in range(90))
    assert talk(port, LINE + cookies + b"Content-Length: 0\r\n\r\n").endswith(b"0 bytes")
    twice = talk(port, plain, plain, pause=0.3)
    assert twice.count(b"5 bytes") >= 1


def test_bodies_are_not_heads(port: int) -> None:
    """However large a body is, it is no head."""
    size = 8 << 20
    head = LINE + b"Content-Length: %d\r\n\r\n" % size
    assert talk(port, head + bytes(100), bytes(size - 100)).endswith(b"%d bytes" % size)


@pytest.mark.parametrize(
    "pieces",
    [
        [LINE, *[b"X-%d: %s\r\n" % (n, b"v" * 1000) for n in range(90)]],
        [LINE + b"X: ", *[b"v" * 10_000] * 50],
        [b"GET /", *[b"a" * 10_000] * 50],
        [CHUNKED + b"X: ", *[b"v" * 10_000] * 50],
    ],
    ids=["lines", "one value", "the address", "after a body"],
)
def test_too_many_bytes(port: int, pieces: list[bytes]) -> None:
    """A head that grows without an end is cut off; so are fields that follow a body."""
    answer = talk(port, *pieces, pause=0.005)
    # None of these requests ever ends: without the limit, this would wait until it times out.
    if answer:
        found = problem(answer)
        assert (found["status"], found["code"]) == (431, "head_too_large")
        assert found["limit_bytes"] == request_limits.MOST_BYTES


def test_too_many_bytes_at_once(port: int) -> None:
    """A head that comes whole in one piece is measured as well."""
    found = problem(
        talk(port, LINE + b"X: " + b"v" * (request_limits.MOST_BYTES + 1) + b"\r\n\r\n")
    )
    assert (found["status"], found["code"]) == (431, "head_too_large")


def test_too_many_fields(port: int) -> None:
    """A hundred fields are enough for anybody."""
    fields = b"".join(b"X-%d: v\r\n" % number for number in range(request_limits.MOST_FIELDS + 1))
    found = problem(talk(port, LINE + fields + b"\r\n"))
    assert (found["status"], found["code"]) == (431, "head_too_large")


def test_what_is_no_http(port: int) -> None:
    """It gets a problem like every other error."""
    found = problem(talk(port, b"\x16\x03\x01\x02\x00 this is TLS\r\n\r\n"))
    assert (found["status"], found["code"]) == (400, "malformed_request")


def test_a_head_that_never_ends(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A byte now and then does not hold a connection for ever."""
    monkeypatch.setattr(request_limits, "LONGEST_S", 0.5)
    start = time.monotonic()
    found = problem(talk(port, LINE, *[b"X"] * 8, pause=0.1))
    assert (found["status"], found["code"], found["retryable"]) == (408, "head_timeout", True)
    assert time.monotonic() - start < 10


def test_a_connection_without_a_request(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is closed without a word, for nothing was asked."""
    monkeypatch.setattr(request_limits, "LONGEST_S", 0.3)
    assert talk(port) == b""


def test_a_slow_body_is_no_slow_head(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock stops with the head; bodies have a limit of their own."""
    monkeypatch.setattr(request_limits, "LONGEST_S", 0.3)
    answer = talk(port, LINE + b"Content-Length: 5\r\n\r\n", *[b"h"] * 5, pause=0.15)
    assert answer.endswith(b"5 bytes")
