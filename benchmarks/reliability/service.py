# SPDX-License-Identifier: Apache-2.0
"""A real service to be mistreated, started as the end-to-end tests start theirs."""

import asyncio
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
from tests.e2e.conftest import Server, launched

from benchmarks.reliability.clouds import Ask

__all__ = ["READY_S", "Reply", "Server", "http", "internal_errors", "post", "probe", "served"]

READY_S = 900.0  # on a core that others use as well, a start takes minutes
_PROBE_S = 0.5


@dataclass(frozen=True)
class Reply:
    """The answer to one request.

    Attributes:
        status: HTTP status, or 0 where the connection broke.
        seconds: from sending to the last byte.
        body: of the answer.
        retry_after: seconds that the service asked to wait, or ``None``.
        code: of the problem, or what the connection died of.
    """

    status: int
    seconds: float
    body: bytes = field(repr=False)
    retry_after: float | None = None
    code: str = ""


@contextmanager
def served(*options: str, **environment: str) -> Iterator[Server]:
    """A service that is ready, with a folder of its own for its files and its log."""
    with tempfile.TemporaryDirectory(prefix="pugeo-") as folder:
        spool = Path(folder) / "spool"
        spool.mkdir()
        named = {"PUGEO_SPOOL_DIR": str(spool), **environment}
        with launched(Path(folder) / "server.log", *options, **named) as server:
            server.wait_until_ready(READY_S)
            yield server


def internal_errors(server: Server) -> float:
    """Requests that the service answered with 500, by its own account."""
    text = httpx2.get(f"{server.url}/metrics").text
    lines = [line for line in text.splitlines() if line.startswith("pugeo_http_requests_total{")]
    return sum(float(line.rpartition(" ")[2]) for line in lines if 'status="500"' in line)


def http() -> httpx2.AsyncClient:
    """A client without limits of its own: what is measured is the service."""
    limits = httpx2.Limits(max_connections=None, max_keepalive_connections=None)
    return httpx2.AsyncClient(limits=limits, timeout=None)


async def post(client: httpx2.AsyncClient, url: str, asked: Ask, seconds: float) -> Reply:
    """Send a request once; whatever happens is a reply."""
    began = time.monotonic()
    try:
        async with asyncio.timeout(seconds):
            response = await client.post(f"{url}/upsample", params=asked.query, content=asked.body)
    except (httpx2.TransportError, TimeoutError) as error:
        return Reply(0, time.monotonic() - began, b"", code=type(error).__name__)
    code = ""
    if response.status_code != 200:
        kind = response.headers.get("content-type", "")
        code = str(response.json().get("code")) if kind.endswith("problem+json") else kind
    wait = response.headers.get("retry-after", "")
    return Reply(
        response.status_code,
        time.monotonic() - began,
        response.content,
        float(wait) if wait.isdecimal() else None,
        code,
    )


async def probe(client: httpx2.AsyncClient, url: str, spent: list[float]) -> None:
    """Ask for ``/health/live`` again and again, until cancelled; enters the seconds of each."""
    while True:
        began = time.monotonic()
        response = await client.get(f"{url}/health/live")
        assert response.status_code == 200, response.text
        spent.append(time.monotonic() - began)
        await asyncio.sleep(_PROBE_S)
