# SPDX-License-Identifier: Apache-2.0
"""Lost workers, departed clients and large requests do not affect other requests."""

import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import httpx2
import numpy as np
import pytest
from tests.http_client import HTTP

from pugeo_model import Cloud, formats

pytestmark = pytest.mark.slow


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str
    process: Any

    def workers(self) -> list[Any]: ...
    def wait_until_ready(self) -> None: ...
    def wait_until_working(self) -> None: ...
    def metric(self, sample: str) -> float: ...


def ball(count: int) -> bytes:
    """A sphere of so many points, as a PLY file."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


SMALL, LARGE = ball(1000), ball(20_000)


@pytest.fixture(scope="module")
def server(slow_server: Server) -> Server:
    """Not the service that other tests share: here the large cloud takes seconds."""
    return slow_server


class Call(threading.Thread):
    """A request in the background."""

    def __init__(self, server: Server, body: bytes, query: str = "?R=2") -> None:
        super().__init__()
        self.url = f"{server.url}/upsample{query}"
        self.body = body
        self.response: httpx2.Response | None = None

    def run(self) -> None:
        """Send it and wait."""
        self.response = HTTP.post(self.url, content=self.body, timeout=300)

    def answer(self) -> httpx2.Response:
        """Wait for the answer."""
        self.join()
        assert self.response is not None
        return self.response


@contextmanager
def running(server: Server, body: bytes) -> Iterator[Call]:
    """A request some of whose patches are finished."""
    call = Call(server, body)
    call.start()
    server.wait_until_working()
    assert call.is_alive(), "the request is too small for this test"
    try:
        yield call
    finally:
        call.join()


def eventually(check: Callable[[], bool], seconds: float = 100.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_killed_worker_costs_a_retry(server: Server) -> None:
    """After SIGKILL of a worker the request succeeds, and the worker is replaced and counted."""
    lost = server.metric('pugeo_worker_restarts_total{reason="lost"}')
    with running(server, LARGE) as call:
        server.workers()[0].kill()
    response = call.answer()
    assert response.status_code == 200, response.text
    assert response.headers["pugeo-points-out"] == "40000"
    eventually(lambda: server.metric('pugeo_worker_restarts_total{reason="lost"}') == lost + 1)
    eventually(lambda: server.metric('pugeo_workers{state="warm"}') == 2)


def test_a_client_that_leaves(server: Server) -> None:
    """The patches of a departed client leave the queue without being finished."""
    address = urlsplit(server.url)
    left = server.metric('pugeo_cancelled_total{reason="disconnect"}')
    made = server.metric('pugeo_points_total{direction="out"}')
    head = f"POST /upsample?R=2 HTTP/1.1\r\nHost: x\r\nContent-Length: {len(LARGE)}\r\n\r\n"
    with socket.create_connection((address.hostname, address.port)) as connection:
        connection.sendall(head.encode() + LARGE)
        server.wait_until_working()
    eventually(lambda: server.metric('pugeo_queue_patches{queue="requests"}') == 0)
    assert server.metric('pugeo_points_total{direction="out"}') == made
    assert server.metric('pugeo_cancelled_total{reason="disconnect"}') == left + 1
    assert HTTP.post(f"{server.url}/upsample", content=SMALL, timeout=100).status_code == 200


def test_a_small_request_does_not_wait_for_a_large_one(server: Server) -> None:
    """A small request is answered while an earlier large one is running."""
    with running(server, LARGE) as large:
        small = Call(server, SMALL)
        small.start()
        assert small.answer().status_code == 200
        assert large.is_alive()
    assert large.answer().status_code == 200


def test_a_large_request_does_not_wait_for_small_ones_without_end(server: Server) -> None:
    """A large request ends while small ones keep all workers busy."""
    large = Call(server, ball(12_000))

    def keep_asking() -> None:
        while large.is_alive():
            small = Call(server, SMALL)
            small.start()
            assert small.answer().status_code == 200

    large.start()
    clients = [threading.Thread(target=keep_asking) for _ in range(4)]
    for client in clients:
        client.start()
    assert large.answer().status_code == 200
    for client in clients:
        client.join()


def test_probes_answer_under_load(server: Server) -> None:
    """Probes are answered during a large request and the parsing of 20 MB of JSON."""
    rows = np.random.default_rng(0).normal(size=(290_000, 3))
    text = b'{"points": ' + np.array2string(rows[:0]).encode().replace(b"[]", b"") + b"["
    text += b",".join(b"[%.17f,%.17f,%.17f]" % tuple(row) for row in rows) + b"]}"
    probes = 0
    with running(server, LARGE), httpx2.Client(timeout=60) as client:
        client.get(f"{server.url}/health/live")
        # It is parsed on a worker and then refused because of its ratio.
        parsed = Call(server, text, "?n_points=1")
        parsed.start()
        while parsed.is_alive():
            assert client.get(f"{server.url}/health/live").status_code == 200
            probes += 1
            time.sleep(0.01)  # probes must not use all of a processor
    assert parsed.answer().status_code == 422
    # A loop that is blocked by the parsing would answer one or two.
    assert probes > 10


def test_the_front_is_light(server: Server) -> None:
    """The front process has not loaded torch, numba or scipy; each worker has."""
    heavy = ("libtorch", "llvmlite", "/scipy/")
    front = Path(f"/proc/{server.process.pid}/maps").read_text()
    assert [name for name in heavy if name in front] == []
    for worker in server.workers():
        its = Path(f"/proc/{worker.pid}/maps").read_text()
        assert [name for name in heavy if name in its] == list(heavy)
