# SPDX-License-Identifier: Apache-2.0
import socket
from typing import Any

import pytest

from pugeo_client._blocking_io import (
    Interrupt,
    InterruptedCallError,
    bounded_io,
    bounding_trace,
    interruptible,
    wait,
)


class Stream:
    """Network stream of an HTTP library; records the timeouts of its operations."""

    def __init__(self) -> None:
        self.timeouts: list[float | None] = []
        self.written = b""
        self.socket, self.peer = socket.socketpair()

    def read(self, _: int, timeout: float | None = None) -> bytes:
        self.timeouts.append(timeout)
        return b"x"

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self.timeouts.append(timeout)
        self.written += buffer

    def get_extra_info(self, name: str) -> Any:
        assert name == "socket"
        return self.socket


@pytest.fixture
def stream() -> Any:
    """A stream that was announced as a new connection."""
    opened = Stream()
    bounding_trace("http11.send_request_headers.started", {"request": None})
    bounding_trace("connection.connect_tcp.complete", {"return_value": opened})
    with opened.socket, opened.peer:
        yield opened


def test_timeouts_end_at_the_deadline(stream: Stream) -> None:
    """Every operation has the smaller of its own timeout and the time left."""
    stream.read(1, timeout=9.0)
    left = iter([5.0, 4.0, 3.0, 1e-9])
    with bounded_io(lambda: next(left)):
        stream.read(1, timeout=9.0)
        stream.read(1, timeout=None)
        stream.write(b"x", timeout=2.0)
        stream.read(1, timeout=2.0)
    stream.read(1, timeout=None)
    assert stream.timeouts == [9.0, 5.0, 4.0, 2.0, 1e-3, None]


def test_a_long_write_ends_at_the_deadline(stream: Stream) -> None:
    """A write is checked every 64 KiB: a peer that reads slowly cannot prolong it."""

    class LateError(Exception):
        pass

    left = iter([2.0, 1.0])

    def remaining() -> float:
        for seconds in left:
            return seconds
        raise LateError

    with bounded_io(remaining), pytest.raises(LateError):
        stream.write(bytes(300_000), timeout=9.0)
    assert len(stream.written) == 2 << 16
    assert stream.timeouts == [2.0, 1.0]


def test_an_interruption_ends_everything(stream: Stream) -> None:
    """An operation that runs is ended by its socket; later ones, and waits, do not begin."""
    interrupt = Interrupt()
    with interruptible(interrupt):
        assert stream.read(1) == b"x"
        with interrupt.using(stream):
            interrupt()
            assert stream.socket.recv(1) == b""
        for operation in (lambda: stream.read(1), lambda: stream.write(b"x"), lambda: wait(600)):
            with pytest.raises(InterruptedCallError):
                operation()
        with interruptible(None):
            assert stream.read(1) == b"x"
    assert stream.read(1) == b"x"
