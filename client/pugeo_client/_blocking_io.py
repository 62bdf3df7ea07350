# SPDX-License-Identifier: Apache-2.0
"""Deadline and interruption of blocking network calls.

The timeouts of the HTTP library bound every single read and write, so that a peer which sends a
byte now and then keeps a call alive for ever. Here each of them ends at the deadline of the whole
call, and another thread can interrupt it.
"""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from pugeo_client.errors import PugeoError

__all__ = [
    "Interrupt",
    "InterruptedCallError",
    "bounded_io",
    "bounding_trace",
    "interruptible",
    "wait",
]

_PIECE = 1 << 16  # bytes: a slow reader of a long write is noticed between pieces
_MIN_TIMEOUT = 1e-3  # seconds; 0 would mean "do not block" to a socket
_OPENED = (".connect_tcp.complete", ".connect_unix_socket.complete", ".start_tls.complete")

_thread = threading.local()


class InterruptedCallError(PugeoError):
    """The call was interrupted by another thread."""


class Interrupt:
    """Ends the blocking calls of other threads, which run inside of `interruptible`."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._streams: set[Any] = set()

    def __call__(self) -> None:
        """Interrupt them now, and all that follow."""
        self._event.set()
        for stream in list(self._streams):
            connection = stream.get_extra_info("socket")
            with contextlib.suppress(OSError):
                # The method of the base class: that of a TLS socket would change its state.
                socket.socket.shutdown(connection, socket.SHUT_RDWR)

    def check(self) -> None:
        """Raise InterruptedCallError after the interruption."""
        if self._event.is_set():
            raise InterruptedCallError("the call was interrupted")

    def wait(self, seconds: float) -> None:
        """Sleep, until the interruption at most."""
        self._event.wait(seconds)
        self.check()

    @contextlib.contextmanager
    def using(self, stream: Any) -> Iterator[None]:
        """Let the interruption end a read or a write of this stream."""
        self._streams.add(stream)
        try:
            self.check()
            yield
        finally:
            self._streams.discard(stream)


@contextlib.contextmanager
def interruptible(interrupt: Interrupt | None) -> Iterator[None]:
    """Let ``interrupt``, or nothing, end the calls that this thread makes inside of the block."""
    before = getattr(_thread, "interrupt", None)
    _thread.interrupt = interrupt
    try:
        yield
    finally:
        _thread.interrupt = before


@contextlib.contextmanager
def bounded_io(remaining: Callable[[], float]) -> Iterator[None]:
    """Bound all network reads and writes of this thread inside of the block.

    Args:
        remaining: returns the seconds until the deadline; raises once it has passed.
    """
    before = getattr(_thread, "remaining", None)
    _thread.remaining = remaining
    try:
        yield
    finally:
        _thread.remaining = before


def bounding_trace(event: str, info: dict[str, Any]) -> None:
    """Make the reads and writes of a new connection obey `bounded_io` and `interruptible`.

    Args:
        event: name of an event of the HTTP library's ``trace`` extension.
        info: its details; ``return_value`` is the network stream of a new connection.
    """
    if not event.endswith(_OPENED):
        return
    stream = info["return_value"]
    read, write = stream.read, stream.write

    def bounded_read(max_bytes: int, timeout: float | None = None) -> bytes:
        with _interruption(stream):
            data: bytes = read(max_bytes, timeout=_bounded(timeout))
            return data

    def bounded_write(buffer: bytes, timeout: float | None = None) -> None:
        with _interruption(stream):
            for start in range(0, len(buffer), _PIECE):
                write(buffer[start : start + _PIECE], timeout=_bounded(timeout))

    stream.read, stream.write = bounded_read, bounded_write


def wait(seconds: float) -> None:
    """Sleep between two attempts, until an interruption at most."""
    interrupt: Interrupt | None = getattr(_thread, "interrupt", None)
    if interrupt is None:
        time.sleep(seconds)
    else:
        interrupt.wait(seconds)


def _interruption(stream: Any) -> contextlib.AbstractContextManager[None]:
    interrupt: Interrupt | None = getattr(_thread, "interrupt", None)
    return contextlib.nullcontext() if interrupt is None else interrupt.using(stream)


def _bounded(timeout: float | None) -> float | None:
    remaining: Callable[[], float] | None = getattr(_thread, "remaining", None)
    if remaining is None:
        return timeout
    left = max(remaining(), _MIN_TIMEOUT)
    return left if timeout is None else min(timeout, left)
