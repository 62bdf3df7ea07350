# SPDX-License-Identifier: Apache-2.0
"""Who may come in, and what browsers may do with an answer. Pure ASGI, as `middleware`."""

from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Receive, Scope, Send

from pugeo_service.keys import Keys
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError

__all__ = ["CORS", "RequireKey", "harden", "is_open"]

# Open without a key: probes, since whoever restarts a service has no business with its clients'
# keys, and the description of the API, which this project publishes anyhow and which tells how
# to use a key. Everything else asks for one, also what does not exist.
_OPEN = frozenset({"/health", "/health/live", "/health/ready", "/docs", "/openapi.json"})
_OPEN_FOLDERS = ("/docs/",)

_NO_PAGE = "default-src 'none'; frame-ancestors 'none'"

# What pages of other origins may send and read, once PUGEO_CORS_ORIGINS lets them. No cookies are
# ever used, so no credentials are.
CORS: dict[str, Any] = {
    "allow_methods": ["GET", "POST", "DELETE"],
    "allow_headers": [
        "Authorization", "Content-Type", "Idempotency-Key", "If-None-Match", "Last-Event-ID",
        "Prefer", "Range", "X-API-Key", "X-Request-ID",
    ],
    "expose_headers": [
        "Accept-Ranges", "Content-Disposition", "Content-Range", "ETag", "Location",
        "Preference-Applied", "Pugeo-Dropped-Duplicate", "Pugeo-Dropped-Non-Finite",
        "Pugeo-Model-Sha256", "Pugeo-Model-Version", "Pugeo-Notes", "Pugeo-Points-In",
        "Pugeo-Points-Out", "Retry-After", "Server-Timing", "X-Request-ID",
    ],
    "max_age": 3600,
}  # fmt: skip


def harden(headers: MutableHeaders) -> None:
    """Add what keeps browsers from guessing, framing, caching and telling others.

    A route that knows better (a page with its scripts, a result that may be cached) sets its own
    ``Content-Security-Policy`` or ``Cache-Control``, which stays.
    """
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Referrer-Policy"] = "no-referrer"
    headers.setdefault("Content-Security-Policy", _NO_PAGE)
    headers.setdefault("Cache-Control", "no-store")


class RequireKey:
    """Lets nobody in without a key, before a byte of the body is read.

    Args:
        app: what it guards; finds the key's name by `keys.owner_of`.
        keys: those that are valid.
        telemetry: where to count who was refused.
    """

    def __init__(self, app: ASGIApp, keys: Keys, telemetry: Telemetry) -> None:
        self._app = app
        self._keys = keys
        self._telemetry = telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one ASGI event."""
        if scope["type"] == "lifespan" or is_open(scope["path"]):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        owner = self._keys.owner(headers)
        if owner is None:
            self._telemetry.rejected.labels("unauthorized").inc()
            await _unauthorized(headers).response(scope)(scope, receive, send)
            return
        scope.setdefault("state", {})["owner"] = owner
        tracing.tag(owner=owner)
        await self._app(scope, receive, send)


def is_open(path: str) -> bool:
    """Whether a path needs no key."""
    return path in _OPEN or path.startswith(_OPEN_FOLDERS)


def _unauthorized(headers: Headers) -> ProblemError:
    given = "authorization" in headers or "x-api-key" in headers
    if given:
        challenge = 'Bearer realm="pugeo", error="invalid_token"'
        detail = "This API key is not known here, or no longer."
    else:
        challenge = 'Bearer realm="pugeo"'
        detail = "An API key is needed: send Authorization: Bearer KEY, or X-API-Key: KEY."
    return ProblemError(401, "unauthorized", detail, headers={"WWW-Authenticate": challenge})
