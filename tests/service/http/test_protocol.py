# SPDX-License-Identifier: Apache-2.0
"""Clients that leave or stop reading, on real sockets."""

import asyncio
import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import uvicorn

from pugeo_service.http import protocol
from pugeo_service.http.protocol import Connection

GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
PIECE, PIECES = bytes(1 << 20), 64


class Large:
    """An application whose answer is large; notes how each request ended."""

    def __init__(self) -> None:
        self.begun = threading.Event()
        self.go = threading.Event()
        self.ended: list[BaseException | None] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        # Whoever listens hears of a client that leaves.
        await receive()
        self.begun.set()
        await asyncio.to_thread(self.go.wait, 30)
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
    """An application that answers before it has read anything."""

    async def __call__(self, scope: Any, _receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            headers = [(b"content-length", b"0")]
            await send({"type": "http.response.start", "status": 413, "headers": headers})
            await send({"type": "http.response.body", "body": b""})


class Short(Large):
    """An application whose answer is smaller than what asyncio would call a full buffer."""

    size = 60_000

    async def __call__(self, scope: Any, _receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            headers = [(b"content-length", str(self.size).encode())]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": bytes(self.size)})


@contextmanager
def serving(app: Large) -> Iterator[tuple[str, int]]:
    """Serve on a free port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        if isinstance(app, Short):
            # Else the kernel would hold all of it.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        config = uvicorn.Config(app, http=Connection, ws="none", lifespan="off", log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield listener.getsockname()
        finally:
            app.go.set()
            server.should_exit = server.force_exit = True
            thread.join(30)


def until_ended(app: Large, seconds: float = 20.0) -> list[BaseException | None]:
    """Wait for the first request to end."""
    end = time.monotonic() + seconds
    while not app.ended and time.monotonic() < end:
        time.sleep(0.02)
    return app.ended


def test_a_client_that_stops_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its connection is cut, and the answer that waited for it is let go."""
    monkeypatch.setattr(protocol, "DEAF_S", 0.2)
    app = Large()
    app.go.set()
    with serving(app) as address, socket.create_connection(address) as client:
        client.sendall(GET)
        assert until_ended(app) == [None]
        client.settimeout(20)
        received = 0
        while data := client.recv(1 << 20):
            received += len(data)
        assert received < len(PIECE) * PIECES


def test_a_client_that_leaves_a_short_answer_lying(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is cut off like any other, though the answer never filled a buffer."""
    monkeypatch.setattr(protocol, "DEAF_S", 0.3)
    with serving(Short()) as address, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(address)
        client.sendall(GET)
        time.sleep(2)
        client.settimeout(20)
        received = 0
        with contextlib.suppress(ConnectionResetError):
            while data := client.recv(1 << 16):
                received += len(data)
        assert received < Short.size


def test_a_client_that_reads_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets everything, though that takes longer than a deaf one is given."""
    monkeypatch.setattr(protocol, "DEAF_S", 0.2)
    app = Large()
    app.go.set()
    received, began = 0, time.monotonic()
    with serving(app) as address, socket.create_connection(address) as client:
        client.sendall(GET)
        while received < len(PIECE) * PIECES:
            received += len(client.recv(1 << 20))
            time.sleep(0.01)
    assert time.monotonic() - began > 0.4
    assert app.ended == [None]


@pytest.mark.parametrize("patient", [False, True])
def test_a_body_that_nobody_reads(monkeypatch: pytest.MonkeyPatch, patient: bool) -> None:
    """After an early answer the rest is thrown away for a while, and no longer than that."""
    monkeypatch.setattr(protocol, "LINGER_S", 20.0 if patient else 0.2)
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 3000\r\n\r\n"
    with serving(Refusal()) as address, socket.create_connection(address) as client:
        client.settimeout(20)
        client.sendall(head)
        assert client.recv(1000).startswith(b"HTTP/1.1 413 ")
        with contextlib.ExitStack() as ends:
            if not patient:
                ends.enter_context(pytest.raises((ConnectionResetError, BrokenPipeError)))
            for _ in range(30):
                client.sendall(bytes(100))
                time.sleep(0.02)
            # The connection is as good as before.
            client.sendall(head)
            if not client.recv(1000):
                raise ConnectionResetError
            assert patient


def test_requests_in_one_breath_of_a_client_that_leaves() -> None:
    """Answering the first one into a closed connection is no error, and the rest is not begun."""
    app = Large()
    with serving(app) as address:
        client = socket.create_connection(address)
        client.sendall(GET * 3)
        assert app.begun.wait(20)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        time.sleep(0.3)
        app.go.set()
        assert until_ended(app) == [None]
        time.sleep(0.3)
        assert app.ended == [None]
