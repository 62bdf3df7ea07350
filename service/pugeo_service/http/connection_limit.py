# SPDX-License-Identifier: Apache-2.0
"""Bound on open connections, below the number of descriptors that the process may have.

Without it, connections that send nothing use up all descriptors; then neither requests nor workers
are served, and each failed accept is an error in the log.
"""

import asyncio
import contextlib
import resource
import time
from typing import Any

import structlog

from pugeo_service.http.request_limits import RequestLimits, encode_response
from pugeo_service.problems import NO_SETTING, ProblemError

__all__ = ["LINGERING", "ConnectionLimit", "usable_descriptors"]

_log = structlog.stdlib.get_logger("pugeo.http")
_LOG_EVERY_S = 60.0
_WANTED_DESCRIPTORS = 65_536
# Refused connections that linger at one time; each holds a descriptor. More are closed at once.
LINGERING = 32


def usable_descriptors(needed: int) -> int:
    """Raise the limit of descriptors of this process as far as it may be; return it.

    Args:
        needed: the least number that is of use; more than these, and 65,536, are not asked for.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    infinite = resource.RLIM_INFINITY
    most = max(needed, _WANTED_DESCRIPTORS)
    # The system has a bound of its own, which may be below that of this process.
    for asked in (most, _WANTED_DESCRIPTORS):
        wanted = asked if hard == infinite else min(hard, asked)
        if soft == infinite or soft >= wanted:
            break
        with contextlib.suppress(OSError, ValueError, OverflowError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            return wanted
    return most if soft == infinite else soft


class _Refusals:
    """Refused connections, of which the log gets one line a minute."""

    def __init__(self) -> None:
        # Those whose clients have not closed them yet.
        self.lingering: set[ConnectionLimit] = set()
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
    # Name of the setting that changes this bound; None if there is none.
    setting: str | None = None
    _refusals = _Refusals()

    @classmethod
    def limited(cls, limit: int, setting: str | None) -> type["ConnectionLimit"]:
        """Return this protocol with another bound.

        Args:
            limit: the largest number of open connections.
            setting: name of the setting that changes it, for refusals; ``None`` if there is none.
        """
        members = {"max_connections": limit, "setting": setting, "_refusals": _Refusals()}
        return type(cls.__name__, (cls,), members)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection, or refuse it."""
        lingering = self._refusals.lingering
        if len(self.connections) - len(lingering) < self.max_connections:
            super().connection_made(transport)
            return
        self._refusals.add(self.max_connections)
        self.transport = self.guarded(transport)
        self.transport.write(encode_response(self._too_many_connections()))
        if len(lingering) < LINGERING:
            # Its client sends a request before it reads the answer.
            self._receiving = True
            self.connections.add(self)  # the end of the server ends it too
            lingering.add(self)
        self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a refused connection."""
        self._refusals.lingering.discard(self)
        super().connection_lost(exc)

    def _too_many_connections(self) -> ProblemError:
        """The problem that a connection beyond the bound receives."""
        fields: dict[str, Any] = {"limit": self.max_connections}
        again = "try again after the time in Retry-After."
        if self.setting is None:
            detail = f"Too many connections to this port; {again} {NO_SETTING}"
        else:
            fields["setting"] = self.setting
            bound = f"{self.setting}, or less if the process may open few files"
            detail = f"Too many connections ({bound}); {again}"
        return ProblemError(503, "too_many_connections", detail, retry_after=5, fields=fields)
