# SPDX-License-Identifier: Apache-2.0
"""Limits on the head of a request, which uvicorn's httptools parser does not have.

Without limits one connection could fill the memory with header lines, or hold its socket by sending
one byte a minute. Refused requests, and bytes that are not HTTP, are answered by problem documents.
"""

import asyncio
import re
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.httptools_impl import RequestResponseCycle

from pugeo_service.http.lingering_close import LingeringClose
from pugeo_service.http.security_headers import add_security_headers
from pugeo_service.problems import NO_SETTING, ProblemError

__all__ = ["RequestLimits", "encode_response"]

MAX_HEAD_BYTES = 64 << 10
MAX_HEAD_FIELDS = 100
HEAD_TIMEOUT_S = 30.0
_HOST = re.compile(rb"[^\x00-\x20\x7f-\xff/?#@\\]*")


class RequestLimits(LingeringClose):
    """HTTP/1.1 with request heads that are bounded in bytes, fields and seconds."""

    _timer: asyncio.TimerHandle | None = None
    _refusal: ProblemError | None = None
    # Bytes since the last complete head or piece of a body: part of a head, or of the trailer
    # fields after a chunked body.
    _bytes = 0
    # Fields of the current request.
    _fields = 0
    _field_bytes = 0
    # Values of Host and Transfer-Encoding of the current request.
    _hosts: list[bytes]
    _codings: list[bytes]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first head."""
        super().connection_made(transport)
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timer."""
        self._cancel_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse bytes; refuse a head that is too large."""
        self._bytes += len(data)
        super().data_received(data)
        # The parser reports a field once it is complete, so a single large one is seen only here.
        if self._bytes > MAX_HEAD_BYTES and not self.transport.is_closing():
            self._refusal = _too_large(f"more than {MAX_HEAD_BYTES:,} bytes")
            self.send_400_response("")

    def on_message_begin(self) -> None:
        """Reset the counters and start the timer of the next head."""
        super().on_message_begin()
        self._fields = self._field_bytes = 0
        self._hosts, self._codings = [], []
        self._start_timer()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Count a field.

        Raises:
            ValueError: there are too many; the parser stops and calls `send_400_response`.
        """
        self._fields += 1
        self._field_bytes += len(name) + len(value)
        if self._fields > MAX_HEAD_FIELDS:
            self._refusal = _too_large(f"more than {MAX_HEAD_FIELDS} fields")
        elif self._field_bytes > MAX_HEAD_BYTES:
            self._refusal = _too_large(f"more than {MAX_HEAD_BYTES:,} bytes")
        if self._refusal is not None:
            # Only an exception stops the parser within the bytes that it was given.
            raise ValueError(self._refusal.detail)
        if name.lower() == b"host":
            self._hosts.append(value)
        elif name.lower() == b"transfer-encoding":
            self._codings.append(value.strip().lower())
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Cancel the timer and start the application.

        Raises:
            ValueError: the head is not that of a request that can be answered (RFC 9112, sections
                3.2 and 6.1); the parser stops and calls `send_400_response`.
        """
        self._refusal = _bad_head(self._hosts, self._codings, self.parser.get_http_version())
        if self._refusal is not None:
            raise ValueError(self._refusal.detail)
        self._bytes = 0
        self._cancel_timer()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a piece of a body on; the application limits its size."""
        self._bytes = 0
        super().on_body(body)

    def send_400_response(self, msg: str) -> None:
        """Answer a request that never reaches the application with a problem; close."""
        del msg
        self._cancel_timer()
        cycle: RequestResponseCycle | None = self.cycle
        if cycle is None or not cycle.response_started or cycle.response_complete:
            problem = self._refusal or ProblemError(
                400, "malformed_request", "The bytes are not an HTTP request."
            )
            self.transport.write(encode_response(problem))
        self.transport.close()

    def _start_timer(self) -> None:
        self._cancel_timer()
        self._timer = self.loop.call_later(HEAD_TIMEOUT_S, self._on_timeout)

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _on_timeout(self) -> None:
        if self._bytes:
            detail = (
                f"The head of the request did not arrive within {HEAD_TIMEOUT_S:g} s. {NO_SETTING}"
            )
            fields = {"limit": HEAD_TIMEOUT_S}
            self._refusal = ProblemError(408, "head_timeout", detail, fields=fields)
            self.send_400_response("")
        else:
            # Browsers open connections before they need them; without a request there is no answer.
            self.transport.close()


def _bad_head(hosts: list[bytes], codings: list[bytes], version: str) -> ProblemError | None:
    if len(hosts) > 1 or (not hosts and version != "1.0"):
        found = "no" if not hosts else "more than one"
        detail = f"The request has {found} Host; an HTTP/1.1 request has exactly one."
        return ProblemError(400, "malformed_request", detail)
    if hosts and not _HOST.fullmatch(hosts[0]):
        detail = "The Host of the request is not a name or address with an optional port."
        return ProblemError(400, "malformed_request", detail)
    if codings and version == "1.0":
        detail = "HTTP/1.0 has no Transfer-Encoding; send Content-Length."
        return ProblemError(400, "malformed_request", detail)
    if codings and codings != [b"chunked"]:
        detail = "Of the transfer codings, only 'chunked' is understood."
        return ProblemError(501, "unsupported_transfer_coding", detail, retryable=False)
    return None


def _too_large(excess: str) -> ProblemError:
    fields: dict[str, Any] = {"limit_bytes": MAX_HEAD_BYTES, "limit_fields": MAX_HEAD_FIELDS}
    detail = f"The head of the request has {excess}. {NO_SETTING}"
    return ProblemError(431, "head_too_large", detail, fields=fields)


def encode_response(problem: ProblemError) -> bytes:
    """Return the bytes of a response that closes its connection."""
    response = problem.response({})
    add_security_headers(response.headers)
    response.headers["Connection"] = "close"
    status = f"HTTP/1.1 {problem.status} {HTTPStatus(problem.status).phrase}".encode()
    fields = (b"%s: %s" % field for field in response.raw_headers)
    return b"\r\n".join((status, *fields, b"", bytes(response.body)))
