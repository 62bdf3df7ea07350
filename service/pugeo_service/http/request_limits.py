# SPDX-License-Identifier: Apache-2.0
"""Limits on the head of a request, which uvicorn's fast parser has none of.

Without them one connection could fill the memory with header lines, or hold its socket for ever
by sending one byte a minute. What the limits refuse, and what is no HTTP at all, is a problem
like every other error.
"""

import asyncio
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from pugeo_service.http.auth import harden
from pugeo_service.problems import ProblemError

__all__ = ["BoundedHeads"]

MOST_BYTES = 64 << 10
MOST_FIELDS = 100
LONGEST_S = 30.0


class BoundedHeads(HttpToolsProtocol):
    """HTTP/1.1 whose request heads are bounded in bytes, fields and seconds."""

    _clock: asyncio.TimerHandle | None = None
    _refusal: ProblemError | None = None
    # Since the last head was whole or the last piece of a body came: a head that goes on, or the
    # fields that may follow a chunked body.
    _bytes = 0
    # Of this request, however its bytes came.
    _fields = 0
    _field_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a head."""
        super().connection_made(transport)
        self._start_clock()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._stop_clock()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse, and refuse what grows without an end."""
        self._bytes += len(data)
        super().data_received(data)
        # The parser gathers a field before it tells of it, so its size shows only here.
        if self._bytes > MOST_BYTES and not self.transport.is_closing():
            self._refusal = _too_large(f"more than {MOST_BYTES:,} bytes")
            self.send_400_response("")

    def on_message_begin(self) -> None:
        """Count anew."""
        super().on_message_begin()
        self._fields = self._field_bytes = 0
        self._start_clock()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Count a field."""
        self._fields += 1
        self._field_bytes += len(name) + len(value)
        if self._fields > MOST_FIELDS:
            self._refusal = _too_large(f"more than {MOST_FIELDS} fields")
        elif self._field_bytes > MOST_BYTES:
            self._refusal = _too_large(f"more than {MOST_BYTES:,} bytes")
        if self._refusal is not None:
            # Nothing else ends the parser's work in the middle of what it was given.
            raise ValueError(self._refusal.detail)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Stop waiting, and let the application begin."""
        self._bytes = 0
        self._stop_clock()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a piece of a body on; its size is the application's business."""
        self._bytes = 0
        super().on_body(body)

    def send_400_response(self, msg: str) -> None:
        """Answer what no application ever sees, as a problem, and hang up."""
        del msg
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is None or not cycle.response_started or cycle.response_complete:
            problem = self._refusal or ProblemError(
                400, "malformed_request", "This is no HTTP request."
            )
            self.transport.write(_on_the_wire(problem))
        self.transport.close()

    def _start_clock(self) -> None:
        self._stop_clock()
        self._clock = self.loop.call_later(LONGEST_S, self._too_slow)

    def _stop_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = None

    def _too_slow(self) -> None:
        if self._bytes:
            detail = f"The head of the request did not arrive within {LONGEST_S:g} s."
            self._refusal = ProblemError(408, "head_timeout", detail)
            self.send_400_response("")
        else:
            # A connection that was opened ahead of its use, as browsers do: no answer to nothing.
            self.transport.close()


def _too_large(what: str) -> ProblemError:
    fields: dict[str, Any] = {"limit_bytes": MOST_BYTES, "limit_fields": MOST_FIELDS}
    detail = f"The head of the request has {what}."
    return ProblemError(431, "head_too_large", detail, fields=fields)


def _on_the_wire(problem: ProblemError) -> bytes:
    response = problem.response({})
    harden(response.headers)
    response.headers["Connection"] = "close"
    status = f"HTTP/1.1 {problem.status} {HTTPStatus(problem.status).phrase}".encode()
    fields = (b"%s: %s" % field for field in response.raw_headers)
    return b"\r\n".join((status, *fields, b"", bytes(response.body)))
