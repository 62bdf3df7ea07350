# SPDX-License-Identifier: Apache-2.0
"""Both clients against a function in the place of a service."""

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from pugeo_client.errors import (
    ConnectionFailedError,
    DeadlineExceededError,
    PugeoError,
    SourceError,
    TooLargeError,
    UnavailableError,
    UnprocessableError,
)

ClientRunner = Callable[..., Any]


class ScriptedService:
    """Gives the next of its answers to each request, and the last one again and again."""

    def __init__(self, *answers: httpx2.Response | Exception) -> None:
        self.answers = list(answers)
        self.requests: list[httpx2.Request] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.requests.append(request)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer

    @property
    def bodies(self) -> list[bytes]:
        return [request.content for request in self.requests]


def dense(ply: bytes) -> httpx2.Response:
    headers = {"X-Request-ID": "abc", "Pugeo-Points-Out": "3", "Server-Timing": "merge;dur=5"}
    return httpx2.Response(200, headers=headers, content=ply)


def problem(
    status: int, *, headers: dict[str, str] | None = None, **fields: Any
) -> httpx2.Response:
    return httpx2.Response(status, headers=headers, json={"code": "x", "detail": "why"} | fields)


def test_the_time_left_is_sent(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """Each attempt of an upsampling sends the seconds left in `Prefer: wait`; others do not."""
    busy = problem(503, headers={"Retry-After": "1"}, retryable=True)
    service = ScriptedService(busy, dense(ply_bytes))
    run_client(lambda client: client.upsample(b"ply", timeout=40.5), service)
    waits = [int(request.headers["Prefer"].removeprefix("wait=")) for request in service.requests]
    assert len(waits) == 2
    assert all(35 <= wait <= 41 for wait in waits)
    service = ScriptedService(dense(ply_bytes))
    run_client(lambda client: client.upsample(b"ply", timeout=0.9), service)
    assert service.requests[0].headers["Prefer"] == "wait=1"
    service = ScriptedService(httpx2.Response(200, json={"models": []}))
    run_client(lambda client: client.models(), service)
    assert "Prefer" not in service.requests[0].headers


def test_a_path_becomes_a_dense_cloud(
    run_client: ClientRunner, ply_bytes: bytes, tmp_path: Path
) -> None:
    """The file is sent unchanged, with the key and the options, and the answer has its arrays."""
    source = tmp_path / "in.ply"
    source.write_bytes(b"ply\nwhatever")
    service = ScriptedService(dense(ply_bytes))
    result = run_client(
        lambda client: client.upsample(source, 4, seed=9),
        service,
        base_url="http://pugeo/base/",
        api_key="secret",
    )
    (request,) = service.requests
    assert service.bodies == [b"ply\nwhatever"]
    assert request.method == "POST"
    assert request.url.path == "/base/upsample"
    assert dict(request.url.params) == {"R": "4.0", "seed": "9", "orient": "auto", "format": "ply"}
    assert request.headers["Authorization"] == "Bearer secret"
    assert request.headers["Content-Length"] == "12"
    assert request.headers["Content-Type"] == "application/x-ply"
    assert result.points.shape == result.normals.shape == (3, 3)
    assert (result.meta.request_id, result.meta.timings) == ("abc", {"merge": 0.005})


def test_arrays_are_sent_as_npz(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """An array in memory is sent as NPZ."""
    service = ScriptedService(dense(ply_bytes))
    run_client(lambda client: client.upsample(np.ones((5, 3), dtype=np.float32)), service)
    sent = np.load(io.BytesIO(service.bodies[0]))
    np.testing.assert_array_equal(sent["points"], np.ones((5, 3)))
    assert service.requests[0].headers["Content-Type"] == "application/x-npz"


@pytest.mark.parametrize(
    ("name", "format", "asked"),
    [("d.ply", None, "ply"), ("d.PLY", None, "ply"), ("d.dat", "ply", "ply")],
)
def test_out_streams_to_a_file(
    run_client: ClientRunner,
    ply_bytes: bytes,
    tmp_path: Path,
    name: str,
    format: str | None,
    asked: str,
) -> None:
    """The answer is in the file, and no temporary file is left."""
    service = ScriptedService(dense(ply_bytes))
    out = tmp_path / name
    result = run_client(lambda client: client.upsample(b"ply\n", out=out, format=format), service)
    assert (result.path, result.data) == (out, None)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert out.read_bytes() == ply_bytes
    assert service.requests[0].url.params["format"] == asked
    assert len(result.points) == 3


def test_out_is_not_touched_by_an_error(run_client: ClientRunner, tmp_path: Path) -> None:
    """A failed call leaves the older file unchanged, and no temporary file."""
    out = tmp_path / "dense.ply"
    out.write_bytes(b"older")
    with pytest.raises(UnprocessableError):
        run_client(lambda client: client.upsample(b"ply\n", out=out), ScriptedService(problem(422)))
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_progress_counts_bytes_both_ways(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """The stages `send` and `receive` both end at their total."""
    seen: list[tuple[str, int, int]] = []
    run_client(
        lambda client: client.upsample(b"x" * 600_000, on_progress=lambda *now: seen.append(now)),
        ScriptedService(dense(ply_bytes)),
    )
    sent = [now for now in seen if now[0] == "send"]
    assert len(sent) > 1
    assert sent[-1] == ("send", 600_000, 600_000)
    assert seen[-1] == ("receive", len(ply_bytes), len(ply_bytes))


def test_an_error_has_the_fields_of_the_problem(run_client: ClientRunner) -> None:
    """The class and fields of the exception are those of the problem; it is not retried."""
    service = ScriptedService(problem(413, code="limit_exceeded", limit=7, request_id="abc"))
    with pytest.raises(TooLargeError) as caught:
        run_client(lambda client: client.upsample(b"ply\n"), service)
    error = caught.value
    assert (error.code, error.fields, error.request_id) == ("limit_exceeded", {"limit": 7}, "abc")
    assert len(service.requests) == 1


def test_retry_after_is_respected(run_client: Any, ply_bytes: bytes, tmp_path: Path) -> None:
    """No retry comes before Retry-After, and each sends the whole file."""
    source = tmp_path / "in.ply"
    source.write_bytes(os.urandom(700_000))
    busy = problem(503, headers={"Retry-After": "7"}, retryable=True)
    service = ScriptedService(busy, httpx2.ConnectError("refused"), dense(ply_bytes))
    result = run_client(lambda client: client.upsample(source), service)
    assert len(result.points) == 3
    assert service.bodies == [source.read_bytes()] * 2 + [source.read_bytes()]
    assert 7 <= run_client.waits[0] < 8
    assert 0.5 <= run_client.waits[1] <= 1


def test_an_open_file_is_rewound_for_a_retry(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """A seekable file is sent from its first position at each attempt."""
    file = io.BytesIO(b"skipped, then ply")
    file.seek(14)
    service = ScriptedService(problem(429), dense(ply_bytes))
    run_client(lambda client: client.upsample(file), service)
    assert service.bodies == [b"ply", b"ply"]


def test_a_pipe_that_was_read_is_not_sent_again(run_client: ClientRunner) -> None:
    """A retry would send the rest of a pipe as if it were all, so the error is raised."""
    reader, writer = os.pipe()
    os.write(writer, b"ply\n")
    os.close(writer)
    service = ScriptedService(problem(503, retryable=True))
    with os.fdopen(reader, "rb") as pipe, pytest.raises(UnavailableError):
        run_client(lambda client: client.upsample(pipe), service)
    assert service.bodies == [b"ply\n"]


def test_retries_are_limited(run_client: Any) -> None:
    """After max_retries retries the last error is raised."""
    service = ScriptedService(problem(503))
    with pytest.raises(UnavailableError):
        run_client(lambda client: client.upsample(b"ply\n"), service, max_retries=2)
    assert (len(service.requests), len(run_client.waits)) == (3, 2)


@pytest.mark.parametrize("asked", ["121", "86400"])
def test_a_long_retry_after_is_raised(run_client: Any, asked: str) -> None:
    """If the service asks for more than two minutes, the call ends with its error."""
    service = ScriptedService(problem(503, headers={"Retry-After": asked}))
    with pytest.raises(UnavailableError) as caught:
        run_client(lambda client: client.upsample(b"ply\n"), service)
    assert caught.value.retry_after == float(asked)
    assert run_client.waits == []


def test_no_wait_beyond_the_deadline(run_client: Any) -> None:
    """With 5 s left and a Retry-After of 60 s there is no retry."""
    service = ScriptedService(problem(503, headers={"Retry-After": "60"}))
    with pytest.raises(UnavailableError):
        run_client(lambda client: client.upsample(b"ply\n", timeout=5), service)
    assert run_client.waits == []


def test_without_time_nothing_is_sent(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """A timeout of 0 ends the call before anything is sent."""
    service = ScriptedService(dense(ply_bytes))
    with pytest.raises(DeadlineExceededError) as caught:
        run_client(lambda client: client.upsample(b"ply\n", timeout=0), service)
    assert isinstance(caught.value, TimeoutError)
    assert service.requests == []


def test_transport_errors_are_translated(run_client: ClientRunner) -> None:
    """An error of the HTTP library becomes one of this package, with the former as its cause."""
    with pytest.raises(ConnectionFailedError) as caught:
        run_client(
            lambda client: client.upsample(b"ply\n"), ScriptedService(httpx2.ReadError("reset"))
        )
    assert isinstance(caught.value.__cause__, httpx2.ReadError)
    service = ScriptedService(httpx2.LocalProtocolError("too little data"))
    with pytest.raises(PugeoError, match="cannot be sent"):
        run_client(lambda client: client.upsample(b"ply\n"), service)
    assert len(service.requests) == 1


def test_a_bad_source_sends_nothing(run_client: ClientRunner) -> None:
    """An input that cannot be sent is refused before any request."""
    service = ScriptedService(problem(500))
    with pytest.raises(SourceError):
        run_client(lambda client: client.upsample(np.zeros((4, 2))), service)
    assert service.requests == []


def test_health(run_client: ClientRunner) -> None:
    """The report is returned as the service sends it."""
    service = ScriptedService(
        httpx2.Response(200, json={"status": "not_ready", "reason": "draining"})
    )
    report = run_client(lambda client: client.health(), service)
    assert report == {"status": "not_ready", "reason": "draining"}
    assert [request.url.path for request in service.requests] == ["/health"]


def test_health_is_asked_once(run_client: Any) -> None:
    """A question for the health is not retried."""
    with pytest.raises(UnavailableError):
        run_client(
            lambda client: client.health(), ScriptedService(httpx2.Response(503, text="<html>"))
        )
    assert run_client.waits == []


def test_models(run_client: ClientRunner) -> None:
    """The cards are returned as the service sends them."""
    cards = [{"name": "standard", "version": "1"}]
    service = ScriptedService(httpx2.Response(200, content=json.dumps({"models": cards})))
    assert run_client(lambda client: client.models(), service) == cards
