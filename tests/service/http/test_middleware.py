# SPDX-License-Identifier: Apache-2.0
"""Middleware: request ids, metrics, and problems for unexpected errors."""

import asyncio
from typing import Any

import orjson
import pytest
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families
from starlette.types import Message, Receive, Scope, Send

from pugeo_service.http.body import ClientDisconnectedError
from pugeo_service.http.middleware import RequestContext
from pugeo_service.observability.telemetry import Readings, Telemetry


class Route:
    """Route that a router puts into the scope."""

    path = "/things/{name}"


def make_telemetry() -> Telemetry:
    """Metrics of an idle service."""
    readings = Readings(1, 2, 3, 4, 5, 6, 7, jobs_patches=8, jobs_capacity=9)
    return Telemetry(lambda: readings, "0.1.0")


def exchange(app: Any, telemetry: Telemetry, request_id: str | None = None) -> list[Message]:
    """Send one request through the middleware; return the messages that it sent."""
    sent: list[Message] = []
    headers = [] if request_id is None else [(b"x-request-id", request_id.encode("latin-1"))]
    scope: Scope = {
        "type": "http",
        "method": "GET",
        "path": "/things/7",
        "query_string": b"",
        "headers": headers,
    }

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(RequestContext(app, lambda: telemetry)(scope, receive, send))
    return sent


def counted(telemetry: Telemetry, name: str) -> dict[tuple[str, ...], float]:
    """The samples of a metric by the values of their labels."""
    text = generate_latest(telemetry.registry).decode()
    return {
        tuple(sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == name
    }


async def answer(scope: Scope, _receive: Receive, send: Send) -> None:
    """An application that answers."""
    scope["route"] = Route()
    await send({"type": "http.response.start", "status": 204, "headers": []})
    await send({"type": "http.response.body", "body": b""})


async def fail(_scope: Scope, _receive: Receive, _send: Send) -> None:
    """An application with a bug."""
    raise KeyError("secret")


async def leave(_scope: Scope, _receive: Receive, _send: Send) -> None:
    """An application whose client left."""
    raise ClientDisconnectedError


async def fail_late(_scope: Scope, _receive: Receive, send: Send) -> None:
    """An application that fails after its headers."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    raise KeyError("secret")


def test_an_id_is_kept() -> None:
    """The request id of a client is returned."""
    start = exchange(answer, make_telemetry(), "my-id.7:a_B")[0]
    assert (b"x-request-id", b"my-id.7:a_B") in start["headers"]


@pytest.mark.parametrize("given", [None, "", "a b", "x" * 129, "caf\xe9", "a\tb"])
def test_an_id_is_made(given: str | None) -> None:
    """A missing id, or one that is unsafe in a log, is replaced."""
    header = dict(exchange(answer, make_telemetry(), given)[0]["headers"])[b"x-request-id"]
    assert len(header) == 24
    assert header != (given or "").encode("latin-1")


def test_requests_are_counted_by_template() -> None:
    """The label is the template of the route and not the path."""
    telemetry = make_telemetry()
    exchange(answer, telemetry)
    assert counted(telemetry, "pugeo_http_requests_total") == {
        ("GET", "/things/{name}", "204"): 1.0
    }
    assert counted(telemetry, "pugeo_http_requests_in_progress") == {(): 0.0}


def test_a_bug_is_a_problem() -> None:
    """500 contains the request id and nothing of the error."""
    telemetry = make_telemetry()
    start, body = exchange(fail, telemetry, "abc")
    found = orjson.loads(body["body"])
    assert (start["status"], found["code"], found["request_id"]) == (500, "internal_error", "abc")
    assert b"secret" not in body["body"]
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "500"): 1.0}


def test_a_client_that_left_is_499() -> None:
    """Nothing is sent to a departed client, which is counted as 499."""
    telemetry = make_telemetry()
    assert exchange(leave, telemetry) == []
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "499"): 1.0}


def test_a_request_that_is_cut_off_is_a_problem() -> None:
    """A request that the server cancels, since it shuts down, gets a 503 that says so."""
    telemetry = make_telemetry()

    async def wait(_scope: Scope, _receive: Receive, _send: Send) -> None:
        asyncio.current_task().cancel()  # type: ignore[union-attr]
        await asyncio.Event().wait()

    start, body = exchange(wait, telemetry)
    found = orjson.loads(body["body"])
    assert (start["status"], found["code"], found["retryable"]) == (503, "draining", True)
    assert b"retry-after" in dict(start["headers"])
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "503"): 1.0}


@pytest.mark.parametrize("grouped", [False, True])
def test_a_client_that_is_cut_is_499(grouped: bool) -> None:
    """A response whose connection is gone stops at its next piece, and is no 200 in the log."""
    gone: list[None] = []
    pieces = 0

    async def stream(scope: Scope, _receive: Receive, send: Send) -> None:
        nonlocal pieces
        scope["pugeo.gone"] = lambda: bool(gone)
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for pieces in range(1, 9):
            if pieces == 3:
                gone.append(None)
            await send({"type": "http.response.body", "body": b"x", "more_body": True})

    async def in_a_group(scope: Scope, receive: Receive, send: Send) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(stream(scope, receive, send))

    telemetry = make_telemetry()
    exchange(in_a_group if grouped else stream, telemetry)
    assert pieces == 3
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "499"): 1.0}


def test_a_late_bug_breaks_the_connection() -> None:
    """After the headers an error is raised, so that the server aborts the connection."""
    with pytest.raises(KeyError):
        exchange(fail_late, make_telemetry())


def test_names_of_the_contract() -> None:
    """The names of all metrics, on which dashboards and alerts rely."""
    telemetry = make_telemetry()
    exchange(answer, telemetry)
    families = {
        family.name
        for family in text_string_to_metric_families(generate_latest(telemetry.registry).decode())
    }
    # Of the process itself, on Linux.
    families -= {name for name in families if name.startswith("process_")}
    assert families == {
        "pugeo_http_requests",
        "pugeo_http_request_duration_seconds",
        "pugeo_http_requests_in_progress",
        "pugeo_queue_patches",
        "pugeo_queue_capacity_patches",
        "pugeo_queue_bytes",
        "pugeo_queue_wait_seconds",
        "pugeo_batch_patches",
        "pugeo_batch_duration_seconds",
        "pugeo_stage_duration_seconds",
        "pugeo_points",
        "pugeo_rejected",
        "pugeo_cancelled",
        "pugeo_jobs",
        "pugeo_runs",
        "pugeo_webhooks",
        "pugeo_jobs_active",
        "pugeo_jobs_bytes",
        "pugeo_workers",
        "pugeo_worker_restarts",
        "pugeo_worker_memory_bytes",
        "pugeo_worker_memory_limit_bytes",
        "pugeo_worker_cpu_cores",
        "pugeo_patch_retries",
        "pugeo_model_info",
        "pugeo_build_info",
    }


def test_readings_are_taken_when_asked_for() -> None:
    """Gauges of the queue and the workers are read at each scrape."""
    telemetry = make_telemetry()
    assert counted(telemetry, "pugeo_queue_patches") == {("requests",): 1.0, ("jobs",): 8.0}
    capacity = counted(telemetry, "pugeo_queue_capacity_patches")
    assert capacity == {("requests",): 2.0, ("jobs",): 9.0}
    assert counted(telemetry, "pugeo_queue_bytes") == {(): 3.0}
    assert counted(telemetry, "pugeo_workers") == {("warm",): 4.0, ("missing",): 5.0}
    assert counted(telemetry, "pugeo_worker_restarts_total") == {("lost",): 6.0}
    assert counted(telemetry, "pugeo_patch_retries_total") == {(): 7.0}


def test_an_error_of_the_disk_is_a_problem() -> None:
    """An OSError before the response is a 500, because not only disconnects cause it."""

    async def fail_to_read(_scope: Scope, _receive: Receive, _send: Send) -> None:
        raise PermissionError("secret")

    start, body = exchange(fail_to_read, make_telemetry(), "abc")
    assert (start["status"], orjson.loads(body["body"])["code"]) == (500, "internal_error")
    assert b"secret" not in body["body"]


def test_a_connection_that_breaks_in_the_middle_is_499() -> None:
    """An OSError during the response is counted as a disconnect."""

    async def break_off(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        raise ConnectionResetError

    telemetry = make_telemetry()
    assert len(exchange(break_off, telemetry)) == 1
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "499"): 1.0}
