# SPDX-License-Identifier: Apache-2.0
"""Bound on open connections, below the number of descriptors that the process may have.

Without it, connections that send nothing use up all descriptors; then neither requests nor workers
are served, and each failed accept is an error in the log.
"""

import asyncio
import resource
import time

import structlog

from pugeo_service.http.request_limits import RequestLimits, encode_response
from pugeo_service.problems import ProblemError

__all__ = ["ConnectionLimit", "usable_descriptors"]

_log = structlog.stdlib.get_logger("pugeo.http")
_LOG_EVERY_S = 60.0
_WANTED_DESCRIPTORS = 65_536


def usable_descriptors() -> int:
    """Raise the limit of descriptors of this process as far as it may be; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _WANTED_DESCRIPTORS if hard == resource.RLIM_INFINITY else hard
    wanted = min(wanted, _WANTED_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return _WANTED_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft


class _Refusals:
    """Refused connections, of which the log gets one line a minute."""

    def __init__(self) -> None:
        self._count = 0
        self._logged = float("-inf")

    def add(self, limit: int) -> None:
        """Count one."""
        self._count += 1
        if time.monotonic() - self._logged >= _LOG_EVERY_S:
            _log.warning("connections refused", refused=self._count, limit=limit)
            self._logged, self._count = time.monotonic(), 0


class ConnectionLimit(RequestLimits):
    """HTTP/1.1 for a bounded number of connections; further ones get 503 and are closed."""

    max_connections = 1000
    _refusals = _Refusals()

    @classmethod
    def limited(cls, limit: int) -> type["ConnectionLimit"]:
        """Return this protocol with another bound."""
        return type(cls.__name__, (cls,), {"max_connections": limit, "_refusals": _Refusals()})

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection, or refuse it."""
        if len(self.connections) < self.max_connections:
            super().connection_made(transport)
            return
        self._refusals.add(self.max_connections)
        self.transport = transport
        setting = "PUGEO_MAX_CONNECTIONS"
        detail = (
            f"Too many connections ({setting}, or less if the process may open few files); try "
            "again after the time in Retry-After."
        )
        fields = {"limit": self.max_connections, "setting": setting}
        problem = ProblemError(503, "too_many_connections", detail, retry_after=5, fields=fields)
        transport.write(encode_response(problem))
        transport.close()

    def data_received(self, data: bytes) -> None:
        """Parse bytes, unless the connection was refused."""
        if not self.transport.is_closing():
            super().data_received(data)
