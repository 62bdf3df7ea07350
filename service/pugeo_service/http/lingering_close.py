# SPDX-License-Identifier: Apache-2.0
"""The end of a connection whose client may still be sending: its answer must not be lost.

A socket that is closed with unread bytes, or that gets bytes later, answers them with a reset, and
a reset discards what the client has not read yet. So the side that writes ends first; what the
client still sends is dropped, for a bounded time and number of bytes, until the client has closed.
"""

import asyncio
from collections.abc import Callable
from typing import Any, cast

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

__all__ = ["LINGER_S", "LingeringClose"]

# Seconds in which the rest of a refused request is received and dropped. Most clients read the
# response only after they have sent the whole body.
LINGER_S = 30.0
# A client that sends nothing for so long has read the answer, or never will.
IDLE_S = 5.0
# Seconds for all of it once the service ends.
END_S = 1.0
# Four times the largest body by default.
MAX_BYTES = 1 << 30


class _Transport:
    """A transport that asks before it closes; all that is not here is that of the other one."""

    def __init__(self, transport: asyncio.Transport, lingers: Callable[[], bool]) -> None:
        self.inner = transport
        self._lingers = lingers
        self._closed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def close(self) -> None:
        """Close, at once or later."""
        if self.is_closing():
            return
        self._closed = True
        if not self._lingers():
            self.inner.close()

    def is_closing(self) -> bool:
        """Return True after `close`, also while the client may still be sending."""
        return self._closed or self.inner.is_closing()

    def write(self, data: bytes) -> None:
        """Write bytes, or drop them after the end as every transport does."""
        if not self.is_closing():
            self.inner.write(data)


class LingeringClose(HttpToolsProtocol):
    """HTTP/1.1 whose connections end without a reset while their client is sending.

    This is a subclass of a private class of uvicorn: pyproject.toml bounds the version of uvicorn,
    and tests/service/test_private_names.py checks that each inherited name exists.
    """

    # A request has begun, and its last byte has not arrived.
    _receiving = False
    _ending = False
    _dropped = 0
    _whole_timer: asyncio.TimerHandle | None = None
    _idle_timer: asyncio.TimerHandle | None = None

    @property
    def lingering(self) -> bool:
        """True while the connection waits for its client to close it."""
        return self._whole_timer is not None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection."""
        super().connection_made(self.guarded(transport))

    def guarded(self, transport: asyncio.Transport) -> asyncio.Transport:
        """Return a transport whose `close` keeps the promise of this class."""
        return cast("asyncio.Transport", _Transport(transport, self._linger))

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        self._cancel_timers()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse bytes, or drop them if the connection is ending."""
        if not self.transport.is_closing():
            super().data_received(data)
            return
        self._dropped += len(data)
        if self._dropped > MAX_BYTES:
            self._inner.abort()
        elif self._idle_timer is not None:
            self._idle_timer.cancel()
            self._idle_timer = self.loop.call_later(IDLE_S, self._on_idle)

    def on_message_begin(self) -> None:
        """Note that a request has begun."""
        self._receiving = True
        super().on_message_begin()

    def on_message_complete(self) -> None:
        """Note that a request has arrived."""
        self._receiving = False
        super().on_message_complete()

    def shutdown(self) -> None:
        """End the connection soon, because the service ends."""
        self._ending = True
        super().shutdown()
        if self.lingering:
            self._cancel_timers()
            self._whole_timer = self.loop.call_later(END_S, self._inner.abort)

    @property
    def _inner(self) -> asyncio.Transport:
        return cast("_Transport", cast("object", self.transport)).inner

    def _linger(self) -> bool:
        """Begin to linger if the client may be sending; otherwise the transport closes at once."""
        inner = self._inner
        if not self._receiving or inner.is_closing() or not inner.can_write_eof():
            return False
        inner.write_eof()
        # A body that nobody read may have paused it.
        inner.resume_reading()
        seconds = END_S if self._ending else LINGER_S
        self._whole_timer = self.loop.call_later(seconds, inner.abort)
        self._idle_timer = self.loop.call_later(IDLE_S, self._on_idle)
        return True

    def _on_idle(self) -> None:
        # A client that is still to read the answer has the whole time for it.
        if not self._inner.get_write_buffer_size():
            self._inner.close()

    def _cancel_timers(self) -> None:
        for timer in (self._whole_timer, self._idle_timer):
            if timer is not None:
                timer.cancel()
        self._whole_timer = self._idle_timer = None
