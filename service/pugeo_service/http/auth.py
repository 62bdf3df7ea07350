# SPDX-License-Identifier: Apache-2.0
"""Authentication by API key, as pure ASGI middleware (see `middleware`)."""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from pugeo_service.keys import Keys
from pugeo_service.observability import tracing
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError

__all__ = ["RequireKey", "is_open"]

# Open without a key: probes, because an orchestrator should not need a client's key, and the
# description of the API, which is public and says how to send a key. All other paths need a key,
# including paths that do not exist.
_OPEN = frozenset({"/", "/health", "/health/live", "/health/ready", "/docs", "/openapi.json"})
_OPEN_FOLDERS = ("/assets/", "/docs/")


class RequireKey:
    """Middleware that refuses requests without a valid API key before their body is read.

    Args:
        app: the application; it finds the key's name by `keys.owner_of`.
        keys: valid keys.
        telemetry: counts refused requests.
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
        detail = "This API key is not valid, or no longer valid."
    else:
        challenge = 'Bearer realm="pugeo"'
        detail = "An API key is needed: send Authorization: Bearer KEY, or X-API-Key: KEY."
    return ProblemError(401, "unauthorized", detail, headers={"WWW-Authenticate": challenge})
