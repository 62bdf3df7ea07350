# SPDX-License-Identifier: Apache-2.0
"""Both clients against real sockets of a faulty server."""

import contextlib
import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pugeo_client.errors import ConnectionFailedError, DeadlineExceededError, TooLargeError

ClientRunner = Callable[..., Any]


def read_request(connection: socket.socket) -> bytes:
    """Read one request with a Content-Length; return the body."""
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


def test_a_cut_answer_is_retried(run_client: ClientRunner, serve: Any, ply_bytes: bytes) -> None:
    """A connection that breaks within the answer is retried."""
    bodies = []

    def script(connection: socket.socket, number: int) -> None:
        bodies.append(read_request(connection))
        cut = ply_bytes[:100] if number == 0 else ply_bytes
        connection.sendall(answer(cut, promised=len(ply_bytes)))

    with serve(script) as url:
        result = run_client(lambda client: client.upsample(b"ply\n1"), base_url=url)
    assert len(result.points) == 3
    assert bodies == [b"ply\n1"] * 2


def test_a_cut_answer_leaves_no_file(run_client: ClientRunner, serve: Any, tmp_path: Path) -> None:
    """An answer that is never complete leaves no file."""

    def script(connection: socket.socket, _: int) -> None:
        read_request(connection)
        connection.sendall(answer(b"ply\n", promised=1000))

    with serve(script) as url, pytest.raises(ConnectionFailedError):
        run_client(lambda client: client.upsample(b"ply\n", out=tmp_path / "d.ply"), base_url=url)
    assert list(tmp_path.iterdir()) == []


def test_silence_ends_at_the_deadline(run_client: ClientRunner, serve: Any) -> None:
    """A service that never answers ends the call at `timeout`."""

    def script(connection: socket.socket, _: int) -> None:
        read_request(connection)
        connection.recv(1)  # returns when the client leaves

    with serve(script) as url, pytest.raises(DeadlineExceededError, match=r"0\.4 s"):
        run_client(lambda client: client.upsample(b"ply\n", timeout=0.4), base_url=url)


@pytest.mark.parametrize(
    "beginning",
    [
        b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nX-Slow: ",
        b"HTTP/1.1 ",
        b"HTTP/1.1 100 Continue\r\n\r\n" * 3 + b"HTTP/1.1 100 ",
    ],
    ids=["body", "header", "status", "informational"],
)
@pytest.mark.parametrize("reused", [False, True])
def test_a_trickle_ends_at_the_deadline(
    run_client: ClientRunner, serve: Any, beginning: bytes, reused: bool
) -> None:
    """One byte now and then keeps every read alive, but not the call, also on an old connection."""
    left_early = threading.Event()

    def script(connection: socket.socket, _: int) -> None:
        for _ in range(reused):
            connection.recv(65536)
            connection.sendall(answer(b"{}"))
        connection.recv(65536)
        if trickle(connection, beginning):
            left_early.set()

    async def in_turn(first: Any, client: Any) -> Any:
        await first
        return await client.health()

    def calls(client: Any) -> Any:
        if not reused:
            return client.health()
        first = client.health()
        return client.health() if isinstance(first, dict) else in_turn(first, client)

    with serve(script) as url, pytest.raises(DeadlineExceededError):
        run_client(calls, base_url=url, timeout=0.5)
    assert left_early.wait(30)


def trickle(connection: socket.socket, beginning: bytes) -> bool:
    """Send the beginning of an answer, and then bytes for 10 s; tell whether the client left."""
    pause = threading.Event()
    try:
        connection.sendall(beginning)
        for _ in range(200):
            connection.sendall(b"1")
            pause.wait(0.05)  # time.sleep only records in these tests
    except OSError:
        return True
    return False


def test_a_slow_reader_ends_at_the_deadline(run_client: ClientRunner, serve: Any) -> None:
    """A service that takes a little of a large upload now and then does not keep the call alive."""

    def script(connection: socket.socket, _: int) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        pause = threading.Event()
        with contextlib.suppress(OSError):
            while connection.recv(2048):
                pause.wait(0.05)

    with serve(script) as url, pytest.raises(DeadlineExceededError):
        run_client(lambda client: client.upsample(bytes(30_000_000)), base_url=url, timeout=0.5)


def test_an_early_refusal_is_read(run_client: ClientRunner, serve: Any) -> None:
    """The error of a service that refuses before it has read the body is raised."""

    def script(connection: socket.socket, _: int) -> None:
        connection.recv(1000)
        connection.sendall(answer(b'{"code": "too_big"}', status="413 Content Too Large"))
        # Read on for a while, as a polite server does: a reset would destroy the answer.
        connection.settimeout(0.3)
        with contextlib.suppress(OSError):
            while connection.recv(1 << 20):
                pass

    with serve(script) as url, pytest.raises(TooLargeError) as caught:
        run_client(lambda client: client.upsample(bytes(30_000_000)), base_url=url)
    assert caught.value.code == "too_big"


def test_a_reset_is_retried(run_client: ClientRunner, serve: Any, ply_bytes: bytes) -> None:
    """A connection that is reset is retried."""

    def script(connection: socket.socket, number: int) -> None:
        read_request(connection)
        if number == 0:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        else:
            connection.sendall(answer(ply_bytes))

    with serve(script) as url:
        assert len(run_client(lambda client: client.upsample(b"ply\n"), base_url=url)) == 3


def test_connection_refused(run_client: Any) -> None:
    """The error names the address and `pugeo serve`, after max_retries retries."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    words = rf"http://127\.0\.0\.1:{port} .*`pugeo serve`.*PUGEO_URL"
    with pytest.raises(ConnectionFailedError, match=words):
        run_client(lambda client: client.upsample(b"ply\n"), base_url=f"http://127.0.0.1:{port}")
    assert len(run_client.waits) == 3
