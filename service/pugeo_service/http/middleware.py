# SPDX-License-Identifier: Apache-2.0
"""Middleware around every request: its id, a log line, metrics, and a problem for a bug.

It is pure ASGI because Starlette's BaseHTTPMiddleware, and with it ``@app.middleware``, hides the
client's disconnect from the routes, so that work for departed clients would go on.
"""

import asyncio
import re
import secrets
import time
from collections.abc import Callable

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pugeo_service.http.body import ClientDisconnectedError
from pugeo_service.http.protocol import GONE
from pugeo_service.http.security_headers import add_security_headers
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import draining, internal_error

__all__ = ["RequestContext"]

_log = structlog.stdlib.get_logger("pugeo.http")
# Request ids of clients must be safe in logs, headers and file names.
_REQUEST_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")
# Addresses of webhooks may contain secrets.
_WEBHOOK = re.compile(r"(\bwebhook=)[^&]*")
_QUIET = frozenset({"/health", "/health/live", "/health/ready", "/metrics"})


def _never() -> bool:
    return False


def _is_departure(error: BaseException) -> bool:
    """Whether an error during a response says that its client has closed the connection."""
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_departure, error.exceptions))
    return isinstance(error, OSError | ClientDisconnectedError)


_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class RequestContext:
    """The outermost middleware.

    Args:
        app: the application.
        telemetry: returns the metrics; called for each request.
    """

    def __init__(self, app: ASGIApp, telemetry: Callable[[], Telemetry]) -> None:
        self._app = app
        self._telemetry = telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one ASGI event."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        await _Exchange(self._app, self._telemetry(), scope)(receive, send)


class _Exchange:
    """One request and its response."""

    def __init__(self, app: ASGIApp, telemetry: Telemetry, scope: Scope) -> None:
        self._app = app
        self._telemetry = telemetry
        self._scope = scope
        self._status = 0
        self._sent = 0
        given = Headers(scope=scope).get("x-request-id", "")
        self._id = given if _REQUEST_ID.fullmatch(given) else secrets.token_hex(12)

    async def __call__(self, receive: Receive, send: Send) -> None:
        scope, telemetry = self._scope, self._telemetry
        scope.setdefault("state", {})["request_id"] = self._id

        async def observed(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = self._id
                add_security_headers(headers)
            elif message["type"] == "http.response.body":
                self._sent += len(message.get("body", b""))
            await send(message)
            # The server drops what is sent to a departed client without a word.
            if scope.get(GONE, _never)():
                raise ClientDisconnectedError

        tracing.tag(request_id=self._id)
        start = time.perf_counter()
        with (
            structlog.contextvars.bound_contextvars(request_id=self._id),
            telemetry.in_progress.track_inprogress(),
        ):
            try:
                await self._app(scope, receive, observed)
            except ClientDisconnectedError:
                self._status = 499
            except asyncio.CancelledError:
                # The server cancels the requests that the time to drain did not suffice for. Of
                # a response that has begun, only the end of the connection can tell.
                if not self._status:
                    await draining().response(scope)(scope, receive, observed)
            except Exception as error:
                if self._status and _is_departure(error):
                    # Most likely the client closed the connection during the response.
                    self._status = 499
                    return
                _log.exception("unexpected error")
                if self._status:
                    # The response has begun, so only a broken connection can report the error.
                    raise
                await internal_error(scope)(scope, receive, observed)
            finally:
                self._count(time.perf_counter() - start)

    def _count(self, seconds: float) -> None:
        scope, telemetry = self._scope, self._telemetry
        # The template of the path, because every unknown path would add a time series.
        route = getattr(scope.get("route"), "path", "unmatched")
        method = scope["method"] if scope["method"] in _METHODS else "OTHER"
        telemetry.requests.labels(method, route, str(self._status or 499)).inc()
        telemetry.request_seconds.labels(method, route).observe(seconds)
        level = "debug" if scope["path"] in _QUIET else "info"
        getattr(_log, level)(
            "request",
            request_id=self._id,
            method=scope["method"],
            path=scope["path"],
            query=_WEBHOOK.sub(r"\1...", scope["query_string"].decode("latin-1")),
            status=self._status or 499,
            seconds=round(seconds, 4),
            bytes_out=self._sent,
            **({"owner": owner} if (owner := scope["state"].get("owner")) else {}),
        )
