# SPDX-License-Identifier: Apache-2.0
"""Around every request: an id, metrics, and no naked error."""

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
    """What routers leave in the scope."""

    path = "/things/{name}"


def make_telemetry() -> Telemetry:
    """Metrics of a service at rest."""
    model = {"name": "standard", "version": "1", "sha256": "ab"}
    return Telemetry(lambda: Readings(1, 2, 3, 4, 5, 6, 7), "0.1.0", model)


def exchange(app: Any, telemetry: Telemetry, request_id: str | None = None) -> list[Message]:
    """Send one request through the middleware; return what it sent."""
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
    """A client's own request id comes back."""
    start = exchange(answer, make_telemetry(), "my-id.7:a_B")[0]
    assert (b"x-request-id", b"my-id.7:a_B") in start["headers"]


@pytest.mark.parametrize("given", [None, "", "a b", "x" * 129, "caf\xe9", "a\tb"])
def test_an_id_is_made(given: str | None) -> None:
    """No id, or one that is unsafe in a log, is replaced."""
    header = dict(exchange(answer, make_telemetry(), given)[0]["headers"])[b"x-request-id"]
    assert len(header) == 24
    assert header != (given or "").encode("latin-1")


def test_requests_are_counted_by_template() -> None:
    """The label is the route and not the path, else every name would add a series."""
    telemetry = make_telemetry()
    exchange(answer, telemetry)
    assert counted(telemetry, "pugeo_http_requests_total") == {
        ("GET", "/things/{name}", "204"): 1.0
    }
    assert counted(telemetry, "pugeo_http_requests_in_progress") == {(): 0.0}


def test_a_bug_is_a_problem() -> None:
    """500 carries the request id and nothing of the error."""
    telemetry = make_telemetry()
    start, body = exchange(fail, telemetry, "abc")
    found = orjson.loads(body["body"])
    assert (start["status"], found["code"], found["request_id"]) == (500, "internal_error", "abc")
    assert b"secret" not in body["body"]
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "500"): 1.0}


def test_a_client_that_left_is_499() -> None:
    """Nothing is sent to nobody, and it is no error of the service."""
    telemetry = make_telemetry()
    assert exchange(leave, telemetry) == []
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "499"): 1.0}


def test_a_late_bug_breaks_the_connection() -> None:
    """After the headers, only the server's own abort tells the client."""
    with pytest.raises(KeyError):
        exchange(fail_late, make_telemetry())


def test_names_of_the_contract() -> None:
    """Dashboards and alerts rely on these names."""
    telemetry = make_telemetry()
    exchange(answer, telemetry)
    families = {
        family.name
        for family in text_string_to_metric_families(generate_latest(telemetry.registry).decode())
    }
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
        "pugeo_jobs_active",
        "pugeo_jobs_bytes",
        "pugeo_workers",
        "pugeo_worker_restarts",
        "pugeo_patch_retries",
        "pugeo_model_info",
        "pugeo_build_info",
    }


def test_readings_are_taken_when_asked_for() -> None:
    """Gauges of the queue and the workers are read at the scrape."""
    telemetry = make_telemetry()
    assert counted(telemetry, "pugeo_queue_patches") == {(): 1.0}
    assert counted(telemetry, "pugeo_queue_capacity_patches") == {(): 2.0}
    assert counted(telemetry, "pugeo_queue_bytes") == {(): 3.0}
    assert counted(telemetry, "pugeo_workers") == {("warm",): 4.0, ("missing",): 5.0}
    assert counted(telemetry, "pugeo_worker_restarts_total") == {("lost",): 6.0}
    assert counted(telemetry, "pugeo_patch_retries_total") == {(): 7.0}


def test_an_error_of_the_disk_is_a_problem() -> None:
    """Whoever is still there gets an answer; OSError is not only what clients that left cause."""

    async def fail_to_read(_scope: Scope, _receive: Receive, _send: Send) -> None:
        raise PermissionError("secret")

    start, body = exchange(fail_to_read, make_telemetry(), "abc")
    assert (start["status"], orjson.loads(body["body"])["code"]) == (500, "internal_error")
    assert b"secret" not in body["body"]


def test_a_connection_that_breaks_in_the_middle_is_499() -> None:
    """What sending raises once the client hung up is no error of the service."""

    async def break_off(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        raise ConnectionResetError

    telemetry = make_telemetry()
    assert len(exchange(break_off, telemetry)) == 1
    assert counted(telemetry, "pugeo_http_requests_total") == {("GET", "unmatched", "499"): 1.0}
