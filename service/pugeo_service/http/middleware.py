# SPDX-License-Identifier: Apache-2.0
"""What happens around every request: an id, a log line, metrics, and no naked 500.

Pure ASGI on purpose. Starlette's BaseHTTPMiddleware, and with it ``@app.middleware``, hides the
client's disconnect from the routes, and work would go on for nobody.
"""

import re
import secrets
import time
from collections.abc import Callable

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pugeo_service.http.auth import harden
from pugeo_service.http.body import ClientDisconnectedError
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import internal_error

__all__ = ["RequestContext"]

_log = structlog.stdlib.get_logger("pugeo.http")
# What a client may call its request: anything that is safe in logs, headers and file names.
_REQUEST_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")
_QUIET = frozenset({"/health", "/health/live", "/health/ready", "/metrics"})
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class RequestContext:
    """The outermost of our layers.

    Args:
        app: what it surrounds.
        telemetry: returns where to count; asked for each request.
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
    """One request and its answer."""

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
                harden(headers)
            elif message["type"] == "http.response.body":
                self._sent += len(message.get("body", b""))
            await send(message)

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
            except Exception as error:
                if self._status and isinstance(error, OSError):
                    # Most likely the client, which hung up in the middle.
                    self._status = 499
                    return
                _log.exception("unexpected error")
                if self._status:
                    # Too late for a problem: only a broken connection tells the client.
                    raise
                await internal_error(scope)(scope, receive, observed)
            finally:
                self._count(time.perf_counter() - start)

    def _count(self, seconds: float) -> None:
        scope, telemetry = self._scope, self._telemetry
        # The template and never the path, else every 404 would add a time series.
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
            query=scope["query_string"].decode("latin-1"),
            status=self._status or 499,
            seconds=round(seconds, 4),
            bytes_out=self._sent,
            **({"owner": owner} if (owner := scope["state"].get("owner")) else {}),
        )
