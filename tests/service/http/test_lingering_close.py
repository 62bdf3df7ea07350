# SPDX-License-Identifier: Apache-2.0
"""Refusals reach clients that are still sending: the connection ends without a reset."""

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import uvicorn
from tests.service.http.fake_loop import connect
from uvicorn.server import ServerState

from pugeo_service.http import connection_limit, lingering_close
from pugeo_service.http.connection_limit import ConnectionLimit
from pugeo_service.http.lingering_close import END_S, IDLE_S, LINGER_S
from pugeo_service.http.protocol import ServerProtocol

BODY = 32 << 20  # more than the buffers of both ends hold
SIZED = b"Content-Length: %d\r\n\r\n" % BODY
REFUSED_HEAD = b"POST / HTTP/1.1\r\nHost: a\r\nHost: b\r\n" + SIZED


async def refuse(scope: Any, _receive: Any, send: Any) -> None:
    """Answer before the body is read."""
    if scope["type"] == "http":
        headers = [(b"content-length", b"7")]
        await send({"type": "http.response.start", "status": 413, "headers": headers})
        await send({"type": "http.response.body", "body": b"refused"})


@contextmanager
def serving(loop: str = "auto", protocol: type[ConnectionLimit] = ServerProtocol) -> Iterator[Any]:
    """A server that refuses each body; yields its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        config = uvicorn.Config(
            refuse, http=protocol, loop=loop, ws="none", lifespan="off", log_config=None
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield listener.getsockname()
        finally:
            server.should_exit = server.force_exit = True
            thread.join(30)


def send_all_then_read(address: Any, *pieces: bytes) -> bytes:
    """The whole answer for a client that reads only after it has sent everything."""
    with socket.create_connection(address, timeout=60) as client:
        for piece in pieces:
            client.sendall(piece)
        answer = b""
        while piece := client.recv(1 << 16):
            answer += piece
        return answer


@pytest.mark.parametrize("loop", ["asyncio", "auto"])
@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"POST / HTTP/1.0\r\n" + SIZED, b"413"),
        (b"POST / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n" + SIZED, b"413"),
        (REFUSED_HEAD, b"400"),
        (b"POST / HTTP/1.1\r\nHost: x\r\n" + b"X: y\r\n" * 200 + SIZED, b"431"),
    ],
    ids=["HTTP/1.0", "close", "malformed", "head too large"],
)
def test_a_refusal_reaches_who_sends_first(loop: str, head: bytes, status: bytes) -> None:
    """A client that reads after its whole body has the answer, whatever ended the connection."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    try:
        with serving(loop) as address:
            answer = send_all_then_read(address, head, bytes(BODY))
    finally:
        logging.getLogger("uvicorn.error").setLevel(logging.NOTSET)
    assert answer.startswith(b"HTTP/1.1 " + status)
    assert b"connection: close" in answer.lower()


@pytest.mark.parametrize("loop", ["asyncio", "auto"])
def test_a_connection_too_many_gets_its_answer(loop: str) -> None:
    """It may send a whole request before it reads; those refused do not count as open."""
    protocol = ServerProtocol.limited(2, "PUGEO_MAX_CONNECTIONS")
    head = b"POST / HTTP/1.1\r\nHost: x\r\n"
    empty = head + b"Content-Length: 0\r\n\r\n"
    with serving(loop, protocol) as address, ExitStack() as opened:
        kept = [
            opened.enter_context(socket.create_connection(address, timeout=60)) for _ in range(2)
        ]
        for each in kept:
            each.sendall(empty)
            assert each.recv(1000).startswith(b"HTTP/1.1 413 ")
        waiting = opened.enter_context(socket.create_connection(address, timeout=60))
        assert waiting.recv(1000).startswith(b"HTTP/1.1 503 ")
        answer = send_all_then_read(address, head + SIZED, bytes(BODY))
        assert answer.startswith(b"HTTP/1.1 503 ")
        kept.pop().close()
        last = head + b"Content-Length: 0\r\nConnection: close\r\n\r\n"
        while b" 413 " not in (answer := send_all_then_read(address, last)):
            assert b" 503 " in answer


def test_those_that_linger_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the bound a refused connection is closed at once; one that ends makes room."""
    monkeypatch.setattr(connection_limit, "LINGERING", 1)
    protocol, state = ServerProtocol.limited(0, None), ServerState()
    first, _, lingers = connect(protocol, state)
    assert (lingers.eof, lingers.ended) == (True, "")
    _, _, closed = connect(protocol, state)
    assert closed.written.startswith(b"HTTP/1.1 503 ")
    assert closed.ended == "close"
    first.connection_lost(None)
    _, _, again = connect(protocol, state)
    assert again.ended == ""


def test_time_and_bytes_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that sends nothing, too long or too much is cut off; nothing of it is parsed."""
    monkeypatch.setattr(lingering_close, "MAX_BYTES", 100)
    made, loop, transport = connect(ServerProtocol)
    made.data_received(REFUSED_HEAD)
    assert (transport.eof, transport.ended) == (True, "")
    answer = transport.written
    made.data_received(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    assert (transport.written, len(loop.active(IDLE_S))) == (answer, 1)
    transport.buffered = 5  # the answer is still on its way
    loop.fire(IDLE_S)
    assert transport.ended == ""
    made.data_received(bytes(100))
    assert transport.ended == "abort"
    for seconds, end in ((IDLE_S, "close"), (LINGER_S, "abort")):
        made, loop, transport = connect(ServerProtocol)
        made.data_received(REFUSED_HEAD)
        loop.fire(seconds)
        assert transport.ended == end
        made.connection_lost(None)
        assert loop.active(IDLE_S) == loop.active(LINGER_S) == []


def test_the_end_of_the_service_does_not_wait_for_them() -> None:
    """A connection that lingers has a second left once the service ends."""
    made, loop, transport = connect(ServerProtocol)
    made.data_received(REFUSED_HEAD)
    made.shutdown()
    assert loop.active(IDLE_S) == loop.active(LINGER_S) == []
    loop.fire(END_S)
    assert transport.ended == "abort"


def test_a_client_that_sends_nothing_more_is_closed_at_once() -> None:
    """An idle connection does not linger."""
    made, _, transport = connect(ServerProtocol)
    made.shutdown()
    assert (transport.eof, transport.ended) == (False, "close")
