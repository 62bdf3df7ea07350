# SPDX-License-Identifier: Apache-2.0
"""Both clients against a service that is played by a function."""

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
    InvalidResponseError,
    PugeoError,
    SourceError,
    TooLargeError,
    UnavailableError,
    UnprocessableError,
)

Twin = Callable[..., Any]


class Played:
    """A service that gives the next of its answers to each request, the last one for ever."""

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


def test_the_service_learns_how_long_the_caller_waits(twin: Twin, ply_bytes: bytes) -> None:
    """Each try says what is left of the call's time, and only where the service works for it."""
    busy = problem(503, headers={"Retry-After": "1"}, retryable=True)
    service = Played(busy, dense(ply_bytes))
    twin(lambda client: client.upsample(b"ply", timeout=40.5), service)
    waits = [int(request.headers["Prefer"].removeprefix("wait=")) for request in service.requests]
    assert len(waits) == 2
    assert all(35 <= wait <= 41 for wait in waits)
    service = Played(dense(ply_bytes))
    twin(lambda client: client.upsample(b"ply", timeout=0.9), service)
    assert service.requests[0].headers["Prefer"] == "wait=1"
    service = Played(httpx2.Response(200, json={"models": []}))
    twin(lambda client: client.models(), service)
    assert "Prefer" not in service.requests[0].headers


def test_a_path_becomes_a_dense_cloud(twin: Twin, ply_bytes: bytes, tmp_path: Path) -> None:
    """The file goes out verbatim, with the key and the options, and the answer has its arrays."""
    source = tmp_path / "in.ply"
    source.write_bytes(b"ply\nwhatever")
    service = Played(dense(ply_bytes))
    result = twin(
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


def test_arrays_go_out_as_npz(twin: Twin, ply_bytes: bytes) -> None:
    """An array in memory needs no file."""
    service = Played(dense(ply_bytes))
    twin(lambda client: client.upsample(np.ones((5, 3), dtype=np.float32)), service)
    sent = np.load(io.BytesIO(service.bodies[0]))
    np.testing.assert_array_equal(sent["points"], np.ones((5, 3)))
    assert service.requests[0].headers["Content-Type"] == "application/x-npz"


@pytest.mark.parametrize(
    ("name", "format", "asked"),
    [("d.ply", None, "ply"), ("d.npz", None, "npz"), ("d.dat", "ply-ascii", "ply-ascii")],
)
def test_out_streams_to_a_file(
    twin: Twin, ply_bytes: bytes, tmp_path: Path, name: str, format: str | None, asked: str
) -> None:
    """The answer lies in the file, whole, and nothing else does."""
    service = Played(dense(ply_bytes))
    out = tmp_path / name
    result = twin(lambda client: client.upsample(b"ply\n", out=out, format=format), service)
    assert (result.path, result.data) == (out, None)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert out.read_bytes() == ply_bytes
    assert service.requests[0].url.params["format"] == asked
    if asked == "ply":
        assert len(result.points) == 3


def test_out_is_not_touched_by_an_error(twin: Twin, tmp_path: Path) -> None:
    """A failed call leaves the older file as it was, and no part of a new one."""
    out = tmp_path / "dense.ply"
    out.write_bytes(b"older")
    with pytest.raises(UnprocessableError):
        twin(lambda client: client.upsample(b"ply\n", out=out), Played(problem(422)))
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"older"]


def test_progress_counts_bytes_both_ways(twin: Twin, ply_bytes: bytes) -> None:
    """Both stages end at their totals."""
    seen: list[tuple[str, int, int]] = []
    twin(
        lambda client: client.upsample(b"x" * 600_000, on_progress=lambda *now: seen.append(now)),
        Played(dense(ply_bytes)),
    )
    sent = [now for now in seen if now[0] == "send"]
    assert len(sent) > 1
    assert sent[-1] == ("send", 600_000, 600_000)
    assert seen[-1] == ("receive", len(ply_bytes), len(ply_bytes))


def test_an_error_carries_what_the_service_said(twin: Twin) -> None:
    """The exception's class and fields are those of the problem; it is not tried again."""
    service = Played(problem(413, code="limit_exceeded", limit=7, request_id="abc"))
    with pytest.raises(TooLargeError) as caught:
        twin(lambda client: client.upsample(b"ply\n"), service)
    error = caught.value
    assert (error.code, error.fields, error.request_id) == ("limit_exceeded", {"limit": 7}, "abc")
    assert len(service.requests) == 1


def test_a_busy_service_is_asked_again_when_it_says(
    twin: Any, ply_bytes: bytes, tmp_path: Path
) -> None:
    """Retry-After is kept, and the file is sent whole at every try."""
    source = tmp_path / "in.ply"
    source.write_bytes(os.urandom(700_000))
    busy = problem(503, headers={"Retry-After": "7"}, retryable=True)
    service = Played(busy, httpx2.ConnectError("refused"), dense(ply_bytes))
    result = twin(lambda client: client.upsample(source), service)
    assert len(result.points) == 3
    assert service.bodies == [source.read_bytes()] * 2 + [source.read_bytes()]
    assert 7 <= twin.waits[0] < 8
    assert 0.5 <= twin.waits[1] <= 1


def test_an_open_file_is_sent_whole_at_every_try(twin: Twin, ply_bytes: bytes) -> None:
    """A seekable file is rewound to where it stood."""
    file = io.BytesIO(b"skipped, then ply")
    file.seek(14)
    service = Played(problem(429), dense(ply_bytes))
    twin(lambda client: client.upsample(file), service)
    assert service.bodies == [b"ply", b"ply"]


def test_a_pipe_that_was_read_is_not_sent_again(twin: Twin) -> None:
    """A second try would send the rest of a stream as if it were the whole: the error stands."""
    reader, writer = os.pipe()
    os.write(writer, b"ply\n")
    os.close(writer)
    service = Played(problem(503, retryable=True))
    with os.fdopen(reader, "rb") as pipe, pytest.raises(UnavailableError):
        twin(lambda client: client.upsample(pipe), service)
    assert service.bodies == [b"ply\n"]


def test_retries_end(twin: Any) -> None:
    """max_retries tries after the first, and then the last error."""
    service = Played(problem(503))
    with pytest.raises(UnavailableError):
        twin(lambda client: client.upsample(b"ply\n"), service, max_retries=2)
    assert (len(service.requests), len(twin.waits)) == (3, 2)


@pytest.mark.parametrize("asked", ["121", "86400"])
def test_a_wait_that_is_too_long_is_the_callers_matter(twin: Any, asked: str) -> None:
    """Nobody sleeps for a day inside a function call."""
    service = Played(problem(503, headers={"Retry-After": asked}))
    with pytest.raises(UnavailableError) as caught:
        twin(lambda client: client.upsample(b"ply\n"), service)
    assert caught.value.retry_after == float(asked)
    assert twin.waits == []


def test_a_wait_past_the_deadline_is_not_begun(twin: Any) -> None:
    """With 5 s left, a service that asks for 60 s gets no second try."""
    service = Played(problem(503, headers={"Retry-After": "60"}))
    with pytest.raises(UnavailableError):
        twin(lambda client: client.upsample(b"ply\n", timeout=5), service)
    assert twin.waits == []


def test_no_time_is_no_request(twin: Twin, ply_bytes: bytes) -> None:
    """A deadline that lies in the past ends the call before anything is sent."""
    service = Played(dense(ply_bytes))
    with pytest.raises(DeadlineExceededError) as caught:
        twin(lambda client: client.upsample(b"ply\n", timeout=0), service)
    assert isinstance(caught.value, TimeoutError)
    assert service.requests == []


def test_transport_failures_are_ours(twin: Twin) -> None:
    """Nothing of the HTTP library reaches the caller; its error is the cause."""
    with pytest.raises(ConnectionFailedError) as caught:
        twin(lambda client: client.upsample(b"ply\n"), Played(httpx2.ReadError("reset")))
    assert isinstance(caught.value.__cause__, httpx2.ReadError)
    service = Played(httpx2.LocalProtocolError("too little data"))
    with pytest.raises(PugeoError, match="cannot be sent"):
        twin(lambda client: client.upsample(b"ply\n"), service)
    assert len(service.requests) == 1


def test_a_bad_source_sends_nothing(twin: Twin) -> None:
    """What cannot be sent is refused on this side."""
    service = Played(problem(500))
    with pytest.raises(SourceError):
        twin(lambda client: client.upsample(np.zeros((4, 2))), service)
    assert service.requests == []


def test_an_answer_that_is_no_ply(twin: Twin) -> None:
    """A page with status 200 is found out when its points are asked for."""
    result = twin(lambda client: client.upsample(b"ply\n"), Played(dense(b"<html>")))
    with pytest.raises(InvalidResponseError):
        _ = result.points


def test_map_keeps_the_order_and_the_options(twin: Twin, ply_bytes: bytes) -> None:
    """Results come in the order of the sources, each with the shared options."""

    def service(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(200, headers={"X-Request-ID": request.content.decode()})

    names = [str(number).encode() for number in range(9)]
    results = twin(lambda client: client.map(names, 2, concurrency=3, seed=5), service)
    assert [result.meta.request_id for result in results] == [name.decode() for name in names]
    counted = Played(dense(ply_bytes))
    twin(lambda client: client.map(names, 2, seed=5), counted)
    assert {request.url.params["seed"] for request in counted.requests} == {"5"}


def test_map_raises_in_its_turn(twin: Twin) -> None:
    """The first cloud that fails ends the loop with its own error."""

    def service(request: httpx2.Request) -> httpx2.Response:
        return problem(422) if request.content == b"bad" else httpx2.Response(200)

    with pytest.raises(UnprocessableError):
        twin(lambda client: client.map([b"good", b"bad", b"good"], concurrency=2), service)


def test_health(twin: Twin) -> None:
    """The service's own words come through."""
    service = Played(httpx2.Response(200, json={"status": "not_ready", "reason": "draining"}))
    report = twin(lambda client: client.health(), service)
    assert report == {"status": "not_ready", "reason": "draining"}
    assert [request.url.path for request in service.requests] == ["/health"]


def test_health_is_asked_once(twin: Any) -> None:
    """Whoever asks how a service is wants to know now, not after three retries."""
    with pytest.raises(UnavailableError):
        twin(lambda client: client.health(), Played(httpx2.Response(503, text="<html>")))
    assert twin.waits == []


def test_models(twin: Twin) -> None:
    """The cards come as the service gives them."""
    cards = [{"name": "standard", "version": "1"}]
    service = Played(httpx2.Response(200, content=json.dumps({"models": cards})))
    assert twin(lambda client: client.models(), service) == cards
