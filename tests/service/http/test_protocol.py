# SPDX-License-Identifier: Apache-2.0
"""Clients that disconnect, do not read, or do not finish a refused body."""

import asyncio
import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import uvicorn
from tests.service.http.fake_loop import connect

from pugeo_service.http import protocol
from pugeo_service.http.protocol import ServerProtocol

GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
PERIOD = 7.0  # seconds on the fake loop
PIECE, PIECES = bytes(1 << 20), 64


class Large:
    """Application with a large answer; records how each request ended."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.go = threading.Event()
        self.ended: list[BaseException | None] = []
        self.calls = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        self.calls += 1
        await receive()
        self.begun.set()
        await asyncio.to_thread(self.go.wait, 60)
        try:
            length = str(len(PIECE) * PIECES).encode()
            headers = [(b"content-length", length)]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            for index in range(PIECES):
                more = index < PIECES - 1
                await send({"type": "http.response.body", "body": PIECE, "more_body": more})
        except BaseException as error:
            self.ended.append(error)
            raise
        self.ended.append(None)


class Refusal(Large):
    """Application that answers before it reads the body."""

    async def __call__(self, scope: Any, _receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            headers = [(b"content-length", b"0")]
            await send({"type": "http.response.start", "status": 413, "headers": headers})
            await send({"type": "http.response.body", "body": b""})


class Short(Large):
    """Application whose answer is smaller than asyncio's limit of a full write buffer."""

    size = 60_000

    async def __call__(self, scope: Any, _receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            headers = [(b"content-length", str(self.size).encode())]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": bytes(self.size)})


class Sized(Large):
    """Application that sends all bytes of its body, and ends the response once the client left."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size
        self.gone: list[bool] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        await receive()
        headers = [(b"content-length", str(self.size).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": bytes(self.size), "more_body": True})
        assert (await receive())["type"] == "http.disconnect"
        self.gone.append(scope[protocol.GONE]())


@contextmanager
def serving(app: Large) -> Iterator[tuple[tuple[str, int], uvicorn.Server]]:
    """Serve on a free port; yields its address and the server."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        if isinstance(app, Short):
            # Otherwise the kernel would buffer the whole answer.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        config = uvicorn.Config(
            app, http=ServerProtocol, ws="none", lifespan="off", log_config=None
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield listener.getsockname(), server
        finally:
            app.go.set()
            server.should_exit = server.force_exit = True
            thread.join(30)


def until(check: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_client_that_stops_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection is cut, and the request ends."""
    monkeypatch.setattr(protocol, "READ_TIMEOUT_S", 0.2)
    app = Large()
    app.go.set()
    with serving(app) as (address, _), socket.create_connection(address) as client:
        client.sendall(GET)
        until(lambda: app.ended == [None])
        client.settimeout(60)
        received = 0
        while data := client.recv(1 << 20):
            received += len(data)
        assert received < len(PIECE) * PIECES


def test_a_client_that_does_not_read_a_short_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection is cut although the write buffer was never full."""
    monkeypatch.setattr(protocol, "READ_TIMEOUT_S", 0.3)
    with serving(Short()) as (address, server), socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(address)
        client.sendall(GET)
        until(lambda: bool(server.server_state.connections))
        until(lambda: not server.server_state.connections)
        client.settimeout(60)
        received = 0
        with contextlib.suppress(ConnectionResetError):
            while data := client.recv(1 << 16):
                received += len(data)
        assert received < Short.size


def test_a_client_that_reads_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """The timer starts again as long as a part of the buffer is read in each period."""
    monkeypatch.setattr(protocol, "READ_TIMEOUT_S", PERIOD)
    made, loop, transport = connect(ServerProtocol)
    transport.buffered = 1000
    made.pause_writing()
    for transport.buffered in (999, 500, 1):
        loop.fire(PERIOD)
        assert (transport.ended, len(loop.active(PERIOD))) == ("", 1)
    loop.fire(PERIOD)
    assert (transport.ended, loop.active(PERIOD)) == ("abort", [])


def test_a_client_that_reads_from_the_kernels_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A steady reader is not cut while the kernel's buffer empties and ours does not."""
    monkeypatch.setattr(protocol, "READ_TIMEOUT_S", PERIOD)
    queued = [4_000_000]
    monkeypatch.setattr(protocol, "_queued", lambda _: queued[0])
    made, loop, transport = connect(ServerProtocol)
    transport.buffered = 1000
    made.pause_writing()
    for queued[0] in (3_700_000, 3_400_000, 3_399_999):
        loop.fire(PERIOD)
        assert (transport.ended, len(loop.active(PERIOD))) == ("", 1)
    loop.fire(PERIOD)
    assert (transport.ended, loop.active(PERIOD)) == ("abort", [])


def test_bytes_in_the_kernels_buffer_are_counted() -> None:
    """Bytes that the other side has not read are known from the kernel."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        near = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
        with near, far:
            near.setblocking(False)
            sent = 0
            with contextlib.suppress(BlockingIOError):
                while True:
                    sent += near.send(bytes(1 << 16))

            class Transport:
                def get_extra_info(self, _name: str) -> socket.socket:
                    return near

            before = protocol._queued(Transport())  # type: ignore[arg-type]
            assert 0 < before <= sent
            near.setblocking(True)
            far.recv(1 << 20, socket.MSG_WAITALL) if sent > 1 << 20 else far.recv(sent)
            until(lambda: protocol._queued(Transport()) < before)  # type: ignore[arg-type]


def test_a_client_that_reads_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """The timer is cancelled when the buffer is no longer full."""
    monkeypatch.setattr(protocol, "READ_TIMEOUT_S", PERIOD)
    made, loop, transport = connect(ServerProtocol)
    transport.buffered = 1000
    made.pause_writing()
    made.resume_writing()
    assert (loop.active(PERIOD), transport.ended) == ([], "")


@pytest.mark.parametrize(("size", "reads", "gone"), [(1000, True, False), (64 << 20, False, True)])
def test_a_client_that_closes_before_the_response_ends(size: int, reads: bool, gone: bool) -> None:
    """It left too early only if it has not got all bytes of the body."""
    app = Sized(size)
    with serving(app) as (address, _), socket.create_connection(address) as client:
        client.sendall(GET)
        received = b""
        while len(received) < (size if reads else 1):
            received += client.recv(1 << 16).rpartition(b"\r\n\r\n")[2]
        client.close()
        until(lambda: bool(app.gone))
    assert app.gone == [gone]


def test_a_body_that_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """After an early answer the body is received for a limited time, then the client is cut off."""
    monkeypatch.setattr(protocol, "LINGER_S", 0.2)
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000000\r\n\r\n"
    with serving(Refusal()) as (address, server), socket.create_connection(address) as client:
        client.settimeout(60)
        client.sendall(head)
        assert client.recv(1000).startswith(b"HTTP/1.1 413 ")
        until(lambda: not server.server_state.connections)
        with contextlib.suppress(ConnectionResetError):
            assert client.recv(1000) == b""


def test_a_refused_body_that_ends() -> None:
    """If the rest of a refused body arrives in time, the connection serves the next request."""
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 3000\r\n\r\n"
    with serving(Refusal()) as (address, _), socket.create_connection(address) as client:
        client.settimeout(60)
        for _ in range(2):
            client.sendall(head)
            assert client.recv(1000).startswith(b"HTTP/1.1 413 ")
            client.sendall(bytes(3000))


def test_pipelined_requests_of_a_client_that_leaves() -> None:
    """The first request ends without an error, and the pipelined ones are not started."""
    app = Large()
    with serving(app) as (address, server):
        client = socket.create_connection(address)
        client.sendall(GET * 3)
        assert app.begun.wait(60)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        until(lambda: not server.server_state.connections)
        app.go.set()
        until(lambda: bool(app.ended))
    # The server has stopped, so no request can begin any more.
    assert (app.ended, app.calls) == ([None], 1)
