# SPDX-License-Identifier: Apache-2.0
"""Both clients against real sockets that misbehave: what no played service can show."""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pugeo_client.errors import ConnectionFailedError, DeadlineExceededError, TooLargeError

Twin = Callable[..., Any]


def read_request(connection: socket.socket) -> bytes:
    """Read one request whose length its header tells; return the body."""
    data = b""
    while b"\r\n\r\n" not in data:
        data += connection.recv(65536)
    head, _, body = data.partition(b"\r\n\r\n")
    (length,) = (int(line[15:]) for line in head.split(b"\r\n") if line.startswith(b"Content-Le"))
    while len(body) < length:
        body += connection.recv(65536)
    return body


def answer(body: bytes, *, promised: int | None = None, status: str = "200 OK") -> bytes:
    length = len(body) if promised is None else promised
    return f"HTTP/1.1 {status}\r\nContent-Length: {length}\r\n\r\n".encode() + body


def test_a_cut_answer_is_fetched_again(twin: Twin, serve: Any, ply_bytes: bytes) -> None:
    """A connection that dies in the middle of the answer costs a retry, not a wrong cloud."""
    bodies = []

    def script(connection: socket.socket, number: int) -> None:
        bodies.append(read_request(connection))
        cut = ply_bytes[:100] if number == 0 else ply_bytes
        connection.sendall(answer(cut, promised=len(ply_bytes)))

    with serve(script) as url:
        result = twin(lambda client: client.upsample(b"ply\n1"), base_url=url)
    assert len(result.points) == 3
    assert bodies == [b"ply\n1"] * 2


def test_a_cut_answer_leaves_no_file(twin: Twin, serve: Any, tmp_path: Path) -> None:
    """A file that never became whole is never there."""

    def script(connection: socket.socket, _: int) -> None:
        read_request(connection)
        connection.sendall(answer(b"ply\n", promised=1000))

    with serve(script) as url, pytest.raises(ConnectionFailedError):
        twin(lambda client: client.upsample(b"ply\n", out=tmp_path / "d.ply"), base_url=url)
    assert list(tmp_path.iterdir()) == []


def test_silence_ends_at_the_deadline(twin: Twin, serve: Any) -> None:
    """A service that takes the request and never answers costs `timeout`, not for ever."""

    def script(connection: socket.socket, _: int) -> None:
        read_request(connection)
        connection.recv(1)

    started = time.monotonic()
    with serve(script) as url, pytest.raises(DeadlineExceededError, match=r"0\.4 s"):
        twin(lambda client: client.upsample(b"ply\n", timeout=0.4), base_url=url)
    assert 0.35 < time.monotonic() - started < 2


def test_a_trickle_ends_at_the_deadline(twin: Twin, serve: Any) -> None:
    """A byte now and then keeps every single read alive, but not the call."""

    def script(connection: socket.socket, _: int) -> None:
        read_request(connection)
        connection.sendall(answer(b"", promised=1000))
        pause = threading.Event()
        with contextlib.suppress(OSError):  # the client leaves when its time is up
            for _ in range(100):
                connection.sendall(b"x")
                pause.wait(0.05)  # time.sleep does not sleep in these tests

    started = time.monotonic()
    with serve(script) as url, pytest.raises(DeadlineExceededError):
        twin(lambda client: client.upsample(b"ply\n", timeout=0.4), base_url=url)
    assert time.monotonic() - started < 2


def test_an_early_refusal_is_heard(twin: Twin, serve: Any) -> None:
    """A service that refuses after the headers, and reads no further, is understood."""

    def script(connection: socket.socket, _: int) -> None:
        connection.recv(1000)
        connection.sendall(answer(b'{"code": "too_big"}', status="413 Content Too Large"))
        # Read on for a while, as a polite server does: a reset would destroy the answer.
        connection.settimeout(0.3)
        with contextlib.suppress(OSError):
            while connection.recv(1 << 20):
                pass

    with serve(script) as url, pytest.raises(TooLargeError) as caught:
        twin(lambda client: client.upsample(bytes(30_000_000)), base_url=url)
    assert caught.value.code == "too_big"


def test_a_reset_is_retried(twin: Twin, serve: Any, ply_bytes: bytes) -> None:
    """A connection reset by a restarting service is tried again."""

    def script(connection: socket.socket, number: int) -> None:
        read_request(connection)
        if number == 0:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        else:
            connection.sendall(answer(ply_bytes))

    with serve(script) as url:
        assert len(twin(lambda client: client.upsample(b"ply\n"), base_url=url)) == 3


def test_nobody_listens(twin: Any) -> None:
    """A port without a service is tried max_retries times and then said to be dead."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(ConnectionFailedError, match="no answer"):
        twin(lambda client: client.upsample(b"ply\n"), base_url=f"http://127.0.0.1:{port}")
    assert len(twin.waits) == 3
