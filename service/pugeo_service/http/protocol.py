# SPDX-License-Identifier: Apache-2.0
"""The HTTP/1.1 protocol of the service: uvicorn's, with limits on slow and departed clients.

A client that disconnects is reported to the running request at once, and its pipelined requests are
dropped. A client that does not read its response, or does not finish a refused body, is cut off.
"""

import array
import asyncio
import contextlib
from collections.abc import Callable, MutableMapping
from typing import Any, cast

from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

from pugeo_service.http.connection_limit import ConnectionLimit
from pugeo_service.http.lingering_close import LINGER_S

__all__ = ["GONE", "ServerProtocol"]

GONE = "pugeo.gone"
"""Member of the ASGI scope: returns whether the client left before it had the whole response."""


# Seconds in which a client must read at least a part of the buffered response.
READ_TIMEOUT_S = 30.0


class ServerProtocol(ConnectionLimit):
    """Protocol of one connection."""

    _running: RequestResponseCycle | None = None
    _delivered = False
    _read_timer: asyncio.TimerHandle | None = None
    _linger_timer: asyncio.TimerHandle | None = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the disconnect to the running request; drop pipelined requests."""
        self._cancel_read_timer()
        self._cancel_linger_timer()
        self.pipeline.clear()
        running = self._running
        if running is not None and not running.response_complete:
            # A client that has all bytes of the body may close the connection before the message
            # that ends the response. Bytes are lost after an error, or with a full write buffer.
            lost = exc is not None or self.flow.write_paused
            self._delivered = not lost and _is_written(running)
            running.disconnected = True
            running.message_event.set()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Start the timers that bound the rest of the body and of the response."""
        answered = self._running
        super().on_response_complete()
        if answered is not None and answered.more_body and not self.transport.is_closing():
            self._linger_timer = self.loop.call_later(LINGER_S, self.transport.abort)
        # The rest may be too small for `pause_writing`; yet closing would wait for it for ever.
        if self.transport.get_write_buffer_size() and self._read_timer is None:
            self._start_read_timer(self._unread())

    def on_message_complete(self) -> None:
        """Cancel the linger timer: the body is complete."""
        self._cancel_linger_timer()
        super().on_message_complete()

    def pause_writing(self) -> None:
        """Start the read timer: the write buffer is full."""
        super().pause_writing()
        self._cancel_read_timer()
        self._start_read_timer(self._unread())

    def resume_writing(self) -> None:
        """Cancel the read timer: the write buffer is no longer full."""
        self._cancel_read_timer()
        super().resume_writing()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Callable[..., Any]) -> None:
        self._running = cycle
        scope: MutableMapping[str, Any] = cast("MutableMapping[str, Any]", cycle.scope)
        scope[GONE] = lambda: cycle.disconnected and not self._delivered
        super()._start_asgi_task(cycle, app)

    def _unread(self) -> int:
        """Bytes of the response that the client has not received yet.

        Those in the kernel's buffer count as well: it holds megabytes, so that a slow reader makes
        progress for minutes without a change of the transport's buffer.
        """
        return self.transport.get_write_buffer_size() + _queued(self.transport)

    def _start_read_timer(self, unread: int) -> None:
        self._read_timer = self.loop.call_later(READ_TIMEOUT_S, self._check_reader, unread)

    def _check_reader(self, before: int) -> None:
        """Cut the connection if the client received nothing since the timer started."""
        self._read_timer = None
        if not self.transport.get_write_buffer_size():
            return
        if (unread := self._unread()) < before:
            self._start_read_timer(unread)
        else:
            # `close` would wait until the buffer is empty.
            self.transport.abort()

    def _cancel_linger_timer(self) -> None:
        if self._linger_timer is not None:
            self._linger_timer.cancel()
            self._linger_timer = None

    def _cancel_read_timer(self) -> None:
        if self._read_timer is not None:
            self._read_timer.cancel()
            self._read_timer = None


def _is_written(cycle: RequestResponseCycle) -> bool:
    """Return whether all bytes of the body were written, by the response's Content-Length."""
    sized = cycle.response_started and cycle.chunked_encoding is False
    return sized and cycle.expected_content_length == 0


def _queued(transport: asyncio.Transport) -> int:
    """Return the bytes that the kernel holds because the client has not confirmed them."""
    connection = transport.get_extra_info("socket")
    count = array.array("i", [0])
    # A system without this count reports none; then only the transport's buffer shows progress.
    with contextlib.suppress(ImportError, OSError, AttributeError, ValueError):
        import fcntl
        import termios

        fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, count)
    return count[0]
