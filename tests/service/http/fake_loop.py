# SPDX-License-Identifier: Apache-2.0
"""A protocol on a fake event loop and transport, so that tests decide when timers fire."""

from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

__all__ = ["FakeLoop", "FakeTransport", "connect"]


class _Timer:
    def __init__(self, seconds: float, call: Callable[[], object]) -> None:
        self.seconds = seconds
        self.call = call
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class _Task:
    def add_done_callback(self, _call: Callable[..., object], **_: Any) -> None: ...


class FakeLoop:
    """Event loop that records timers and never runs tasks."""

    def __init__(self) -> None:
        self._timers: list[_Timer] = []

    def call_later(self, seconds: float, call: Callable[..., object], *args: Any) -> _Timer:
        self._timers.append(_Timer(seconds, lambda: call(*args)))
        return self._timers[-1]

    def create_task(self, work: Any, **_: Any) -> Any:
        work.close()
        return _Task()

    def active(self, seconds: float) -> list[_Timer]:
        """Timers of this length that are neither cancelled nor fired."""
        return [t for t in self._timers if t.seconds == seconds and not t.cancelled]

    def fire(self, seconds: float) -> None:
        """Fire the only active timer of this length."""
        (timer,) = self.active(seconds)
        timer.cancelled = True
        timer.call()


class FakeTransport:
    """Transport that records written bytes.

    Attributes:
        written: all bytes.
        buffered: size of the write buffer, set by tests.
        eof: no more is written, yet the connection is open.
        ended: "close" or "abort" once called.
    """

    def __init__(self) -> None:
        self.written = b""
        self.buffered = 0
        self.eof = False
        self.ended = ""

    def write(self, data: bytes) -> None:
        self.written += data

    def can_write_eof(self) -> bool:
        return True

    def write_eof(self) -> None:
        self.eof = True

    def close(self) -> None:
        self.ended = self.ended or "close"

    def abort(self) -> None:
        self.ended = "abort"

    def is_closing(self) -> bool:
        return bool(self.ended)

    def get_write_buffer_size(self) -> int:
        return self.buffered

    def get_extra_info(self, _name: str, default: Any = None) -> Any:
        return default

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...

    def set_protocol(self, _protocol: Any) -> None: ...


async def _app(_scope: Any, _receive: Any, _send: Any) -> None: ...


def connect(
    protocol: type[HttpToolsProtocol], state: ServerState | None = None
) -> tuple[Any, FakeLoop, FakeTransport]:
    """Return a connected protocol with its loop and transport, of this server or one of its own."""
    config = uvicorn.Config(_app, http=protocol, ws="none", lifespan="off", log_config=None)
    config.load()
    loop, transport = FakeLoop(), FakeTransport()
    made: Any = protocol(config, state or ServerState(), {}, loop)  # type: ignore[arg-type]
    made.connection_made(transport)
    return made, loop, transport
