# SPDX-License-Identifier: Apache-2.0
"""Open connections are bounded: further ones are refused, with few words in the log."""

import json
import logging
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import structlog
import uvicorn

from pugeo_service import server as server_module
from pugeo_service.app import create_service
from pugeo_service.http import connection_limit, request_limits
from pugeo_service.http.connection_limit import usable_descriptors
from pugeo_service.http.protocol import ServerProtocol
from pugeo_service.models import Models
from pugeo_service.settings import Settings

GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
LIMIT = 3


async def hello(_scope: Any, _receive: Any, send: Any) -> None:
    """Answer."""
    headers = [(b"content-length", b"5")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": b"hello"})


@pytest.fixture
def address() -> Iterator[tuple[str, int]]:
    """Address of a server for three connections."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        protocol = ServerProtocol.limited(LIMIT, "PUGEO_MAX_CONNECTIONS")
        config = uvicorn.Config(hello, http=protocol, ws="none", lifespan="off", log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        yield listener.getsockname()
        server.should_exit = server.force_exit = True
        thread.join(30)


def asked(connection: socket.socket) -> bytes:
    """The answer to a request on a connection."""
    connection.settimeout(30)
    connection.sendall(GET)
    answer = b""
    while not answer.endswith(b"hello"):
        if not (piece := connection.recv(1 << 16)):
            break
        answer += piece
    return answer


def test_idle_connections_are_bounded(
    address: tuple[str, int], caplog: pytest.LogCaptureFixture
) -> None:
    """Connections beyond the bound get 503 and are closed; one that ends makes room."""
    caplog.set_level(logging.CRITICAL, "uvicorn.error")
    with structlog.testing.capture_logs() as logs, ExitStack() as opened:
        kept = [opened.enter_context(socket.create_connection(address)) for _ in range(LIMIT)]
        for each in kept:
            assert asked(each).endswith(b"hello")
        for _ in range(20):
            with socket.create_connection(address, timeout=30) as refused:
                answer = b""
                while piece := refused.recv(1 << 16):
                    answer += piece
            head, _, body = answer.partition(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 503 ")
            assert b"retry-after" in head.lower()
            assert json.loads(body)["code"] == "too_many_connections"
        kept[0].close()
        while b"hello" not in (answer := _try(address)):
            assert b" 503 " in answer
        assert [entry["event"] for entry in logs].count("connections refused") == 1


def _try(address: tuple[str, int]) -> bytes:
    with socket.create_connection(address, timeout=30) as connection:
        return asked(connection)


def test_the_bound_leaves_descriptors_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound is below the number of descriptors, whatever the setting says."""
    monkeypatch.setattr(server_module, "usable_descriptors", lambda _: 1024)
    bound = server_module._connections(Settings(max_connections=100_000))
    assert 256 < bound < 1024 - 128
    assert server_module._connections(Settings(max_connections=5)) == 5


@pytest.mark.parametrize(
    "given", [{"queue_requests": 20_000}, {"jobs_running": 1 << 53}, {"max_connections": 1}]
)
def test_a_queue_needs_descriptors(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], given: dict[str, int]
) -> None:
    """Settings that leave fewer connections than requests of a full queue end with one line."""
    asked: list[int] = []

    def files(needed: int) -> int:
        asked.append(needed)
        return 1024 if "max_connections" not in given else 160

    monkeypatch.setattr(server_module, "usable_descriptors", files)
    assert server_module.main(given) == 2
    (line,) = capsys.readouterr().err.splitlines()
    settings = Settings(**given)  # type: ignore[arg-type]
    assert line.startswith(
        f"PUGEO_QUEUE_REQUESTS={settings.queue_requests}, "
        f"PUGEO_JOBS_RUNNING={settings.jobs_running}: "
    )
    assert f"need {asked[0]:,} open files" in line
    monkeypatch.setattr(server_module, "usable_descriptors", lambda needed: needed)
    assert server_module._too_few_descriptors(settings) is None
    least = min(settings.queue_requests, settings.max_connections)
    assert server_module._connections(settings) == least


def test_descriptors_are_raised_as_far_as_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The soft limit becomes the hard one, but no more than 65,536 where so many suffice."""
    given: list[Any] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: given.append(limits))
    infinite = resource.RLIM_INFINITY
    for limits, needed, expected in (
        ((1024, 4096), 100, 4096),
        ((1024, infinite), 100, 65_536),
        ((1024, 1 << 20), 100_000, 100_000),
        ((4096, 4096), 100_000, 4096),
        ((infinite, infinite), 100, 65_536),
    ):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limits=limits: limits)
        assert usable_descriptors(needed) == expected
    assert given == [(4096, 4096), (65_536, infinite), (100_000, 1 << 20)]


def test_a_bound_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    """The usual number is asked for if the system allows fewer than this process may have."""

    def bounded(_: int, limits: tuple[int, int]) -> None:
        if limits[0] > 70_000:
            raise ValueError

    monkeypatch.setattr(resource, "setrlimit", bounded)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, resource.RLIM_INFINITY))
    assert usable_descriptors(100_000) == 65_536


def test_connections_to_the_metrics_end(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A connection to the port of metrics that sends nothing is closed; others are answered."""
    monkeypatch.setattr(request_limits, "HEAD_TIMEOUT_S", 0.3)
    monkeypatch.setattr(server_module, "_METRICS_CONNECTIONS", 2)
    settings = Settings(engine="inline", spool_dir=tmp_path)
    service = create_service(settings, Models(settings))
    with structlog.testing.capture_logs() as logs, server_module._metrics("127.0.0.1", 0, service):
        port = next(entry["port"] for entry in logs if entry["event"] == "metrics")
        with socket.create_connection(("127.0.0.1", port), timeout=30) as idle:
            assert b'pugeo_workers{state="warm"} 0.0' in _scrape(port)
            assert idle.recv(1) == b""
        with ExitStack() as opened:
            for _ in range(2):
                opened.enter_context(socket.create_connection(("127.0.0.1", port)))
            refused = _scrape(port)
        assert b" 503 " in refused
        problem = json.loads(refused.partition(b"\r\n\r\n")[2])
        # Not the setting of the main port, which has another bound.
        assert problem["limit"] == 2
        assert "setting" not in problem
        assert "PUGEO_MAX_CONNECTIONS" not in problem["detail"]


def _scrape(port: int) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.sendall(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
    return answer


def test_one_line_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """The log gets a line at once, and then one for all refusals of a minute."""
    seconds = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: seconds[0])
    refusals = connection_limit._Refusals()
    with structlog.testing.capture_logs() as logs:
        for _ in range(200):
            refusals.add(LIMIT)
            seconds[0] += 0.5
    assert [entry["refused"] for entry in logs] == [1, 120]
