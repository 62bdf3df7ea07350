# SPDX-License-Identifier: Apache-2.0
"""Limits on request heads in bytes, fields and seconds."""

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
from tests.service.http.fake_loop import connect

from pugeo_service.http import request_limits
from pugeo_service.http.request_limits import HEAD_TIMEOUT_S, RequestLimits

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
    """Port of a server with these limits."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        echo, http=RequestLimits, ws="none", lifespan="off", log_config=None, access_log=False
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
    """Send pieces and read until the server closes or the answer is complete."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        for piece in pieces:
            connection.sendall(piece)
            time.sleep(pause)
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
            if answer.endswith(b"bytes"):
                break
        return answer


def problem(answer: bytes) -> dict[str, Any]:
    """Return the problem of an answer, whose connection must be closed."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head
    assert b"connection: close" in head.lower()
    assert b"nosniff" in head
    found: dict[str, Any] = json.loads(body)
    assert head.startswith(b"HTTP/1.1 %d " % found["status"])
    return found


def test_good_requests_pass(port: int) -> None:
    """Usual requests pass: byte by byte, with trailers, with many fields, pipelined."""
    plain = LINE + b"Content-Length: 5\r\n\r\nhello"
    assert talk(port, plain).endswith(b"5 bytes")
    assert talk(port, *(bytes([byte]) for byte in plain)).endswith(b"5 bytes")
    assert talk(port, CHUNKED + b"A: b\r\n\r\n").endswith(b"5 bytes")
    cookies = b"".join(b"X-%d: %s\r\n" % (number, b"v" * 500) for number in range(90))
    assert talk(port, LINE + cookies + b"Content-Length: 0\r\n\r\n").endswith(b"0 bytes")
    assert talk(port, plain, plain).endswith(b"5 bytes")


def test_bodies_are_not_heads(port: int) -> None:
    """The size of a body does not count for the head."""
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
    """A head without an end is refused, and so are endless trailer fields."""
    answer = talk(port, *pieces, pause=0.005)
    # No request is complete: without the limit, the socket would time out.
    found = problem(answer)
    assert (found["status"], found["code"]) == (431, "head_too_large")
    assert found["limit_bytes"] == request_limits.MAX_HEAD_BYTES


def test_too_many_bytes_at_once(port: int) -> None:
    """A head in one piece is limited too."""
    found = problem(
        talk(port, LINE + b"X: " + b"v" * (request_limits.MAX_HEAD_BYTES + 1) + b"\r\n\r\n")
    )
    assert (found["status"], found["code"]) == (431, "head_too_large")


def test_too_many_fields(port: int) -> None:
    """The number of fields is limited."""
    fields = b"".join(
        b"X-%d: v\r\n" % number for number in range(request_limits.MAX_HEAD_FIELDS + 1)
    )
    found = problem(talk(port, LINE + fields + b"\r\n"))
    assert (found["status"], found["code"]) == (431, "head_too_large")


def test_what_is_no_http(port: int) -> None:
    """Bytes that are not HTTP are answered with a problem."""
    found = problem(talk(port, b"\x16\x03\x01\x02\x00 this is TLS\r\n\r\n"))
    assert (found["status"], found["code"]) == (400, "malformed_request")


def test_a_head_that_never_ends(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """An incomplete head is answered with 408."""
    monkeypatch.setattr(request_limits, "HEAD_TIMEOUT_S", 0.5)
    found = problem(talk(port, LINE))
    assert (found["status"], found["code"], found["retryable"]) == (408, "head_timeout", True)


def test_bytes_do_not_restart_the_timer() -> None:
    """Further bytes of a head do not extend its time."""
    protocol, loop, transport = connect(RequestLimits)
    (timer,) = loop.active(HEAD_TIMEOUT_S)
    protocol.data_received(LINE)  # the parser reports the begin of a request
    (timer,) = loop.active(HEAD_TIMEOUT_S)
    for _ in range(8):
        protocol.data_received(b"X")
    assert loop.active(HEAD_TIMEOUT_S) == [timer]
    loop.fire(HEAD_TIMEOUT_S)
    assert transport.written.startswith(b"HTTP/1.1 408 ")
    assert (transport.eof, transport.ended) == (True, "")


def test_a_connection_without_a_request() -> None:
    """A connection without a request is closed without an answer."""
    _, loop, transport = connect(RequestLimits)
    loop.fire(HEAD_TIMEOUT_S)
    assert (transport.written, transport.ended) == (b"", "close")


def test_a_slow_body_is_no_slow_head() -> None:
    """The timer stops at the end of the head; bodies have their own limit."""
    protocol, loop, transport = connect(RequestLimits)
    protocol.data_received(LINE + b"Content-Length: 5\r\n\r\n")
    assert loop.active(HEAD_TIMEOUT_S) == []
    for _ in range(4):
        protocol.data_received(b"h")
    assert loop.active(HEAD_TIMEOUT_S) == []
    assert transport.ended == ""


@pytest.mark.parametrize(
    "head",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: a\r\n\r\n",
        b"GET / HTTP/1.0\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a/b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: u@a\r\n\r\n",
        b"POST / HTTP/1.0\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    ],
)
def test_a_head_without_one_host(port: int, head: bytes) -> None:
    """No Host, two, or one of another form is 400 (RFC 9112, section 3.2)."""
    assert problem(talk(port, head))["code"] == "malformed_request"


@pytest.mark.parametrize("host", [b"a", b"a:8000", b"[::1]:80", b"", b"a_b.c-d"])
def test_hosts_that_are_taken(port: int, host: bytes) -> None:
    """Names and addresses are taken, with a port or without; HTTP/1.0 needs none."""
    assert talk(port, b"GET / HTTP/1.1\r\nHost: %s\r\n\r\n" % host).endswith(b"0 bytes")
    assert talk(port, b"GET / HTTP/1.0\r\n\r\n").endswith(b"0 bytes")


@pytest.mark.parametrize("coding", [b"gzip", b"gzip, chunked", b"identity", b"xchunked"])
def test_transfer_codings_that_nobody_knows(port: int, coding: bytes) -> None:
    """A transfer coding that is not understood is 501 (RFC 9112, section 6.1)."""
    answer = talk(port, LINE + b"Transfer-Encoding: %s\r\n\r\n0\r\n\r\n" % coding)
    found = problem(answer)
    assert (found["status"], found["code"]) == (501, "unsupported_transfer_coding")


@pytest.mark.parametrize(
    "fields", [b"chunked, chunked", b"chunked\r\nTransfer-Encoding: chunked", b""]
)
def test_broken_transfer_codings(port: int, fields: bytes) -> None:
    """Chunked twice, or no coding at all, is malformed."""
    answer = talk(port, LINE + b"Transfer-Encoding: %s\r\n\r\n0\r\n\r\n" % fields)
    assert problem(answer)["status"] == 400
