# SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests that run on both clients: `run_client` makes a call and returns its result."""

import asyncio
import inspect
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx2
import numpy as np
import pytest

from pugeo_client import AsyncClient, Client

Handler = Callable[[httpx2.Request], httpx2.Response]
Call = Callable[[Any], Any]


class ClientRunner:
    """Runs a call on `Client` or on `AsyncClient`, against a handler or a real address."""

    def __init__(self, kind: str, waits: list[float]) -> None:
        self.kind = kind
        self.waits = waits
        """Seconds of every wait between attempts; they are recorded instead of slept."""

    def __call__(self, call: Call, handler: Handler | None = None, **options: Any) -> Any:
        if self.kind == "sync":
            return self._wait(call, handler, options)
        return asyncio.run(self._await(call, handler, options))

    def _wait(self, call: Call, handler: Handler | None, options: dict[str, Any]) -> Any:
        transport = httpx2.MockTransport(handler) if handler else None
        with httpx2.Client(transport=transport) as http, Client(http_client=http, **options) as one:
            outcome = call(one)
            return list(outcome) if inspect.isgenerator(outcome) else outcome

    async def _await(self, call: Call, handler: Handler | None, options: dict[str, Any]) -> Any:
        transport = httpx2.MockTransport(handler) if handler else None
        async with (
            httpx2.AsyncClient(transport=transport) as http,
            AsyncClient(http_client=http, **options) as one,
        ):
            outcome = call(one)
            if isinstance(outcome, AsyncIterator):
                return [result async for result in outcome]
            return await outcome


@pytest.fixture(params=["sync", "async"])
def run_client(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ClientRunner:
    """Either client; its waits between attempts are recorded instead of slept."""
    waits: list[float] = []

    async def record(seconds: float) -> None:
        waits.append(seconds)

    monkeypatch.delenv("PUGEO_URL", raising=False)
    monkeypatch.delenv("PUGEO_API_KEY", raising=False)
    monkeypatch.setattr("pugeo_client._blocking_io.time.sleep", waits.append)
    monkeypatch.setattr("pugeo_client.jobs.asyncio.sleep", record)
    return ClientRunner(request.param, waits)


@pytest.fixture(scope="session")
def ply_bytes() -> bytes:
    """Three points with normals, colours, a scalar and a label, as the service writes them."""
    dtype = [(name, "<f8") for name in "xyz"] + [(name, "<f4") for name in ("nx", "ny", "nz")]
    dtype += [(name, "u1") for name in ("red", "green", "blue")]
    dtype += [("intensity", "<f4"), ("label", "<i4")]
    rows = np.zeros(3, dtype=dtype)
    rows["x"], rows["y"], rows["z"] = [500000.125, 2, 3], [4, 5, 6], [7, 8, 9]
    rows["nz"], rows["red"], rows["intensity"], rows["label"] = 1, [1, 2, 255], 0.5, [7, 8, 9]
    kinds = {"<f8": "double", "<f4": "float", "u1": "uchar", "<i4": "int"}
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in dtype)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{properties}end_header\n"
    return header.encode() + rows.tobytes()


@contextmanager
def scripted_server(script: Callable[[socket.socket, int], None]) -> Iterator[str]:
    """Serve raw sockets: `script` is run for each connection, with its number, in a thread."""
    listener = socket.create_server(("127.0.0.1", 0))

    def accept() -> None:
        number = 0
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=run, args=(connection, number), daemon=True).start()
            number += 1

    def run(connection: socket.socket, number: int) -> None:
        with connection:
            script(connection, number)

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(5)


@pytest.fixture(scope="session")
def serve() -> Callable[..., Any]:
    """`with serve(script) as url`: a server whose every connection is handled by the script."""
    return scripted_server
