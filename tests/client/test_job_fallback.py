# SPDX-License-Identifier: Apache-2.0
"""Clouds that exceed the time limit of a request are submitted as jobs."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from pugeo_client.errors import ServerDeadlineError, UnprocessableError

ClientRunner = Callable[..., Any]
ID = "01a201f3ed23172a420e035311bb2554"


class Service:
    """A service whose requests end after its time limit, and whose jobs do not."""

    def __init__(
        self, ply: bytes, *, jobs: str = "succeeded", code: str = "deadline_exceeded", **fields: Any
    ) -> None:
        self._ply = ply
        self._jobs = jobs
        self._problem = {"code": code, "detail": "too long"} | fields
        self.calls: list[str] = []
        self.bodies: list[bytes] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.calls.append(f"{request.method} {request.url.path}")
        if request.url.path == "/upsample":
            return httpx2.Response(504, json=self._problem)
        if request.method == "POST":
            self.bodies.append(request.content)
            if self._jobs == "none":
                return httpx2.Response(404, json={"code": "not_found", "detail": "x"})
        if request.url.path.endswith("/result"):
            return httpx2.Response(200, content=self._ply, headers={"Pugeo-Points-Out": "3"})
        problem = {"status": 422, "code": "too_few_points"} if self._jobs == "failed" else None
        record = {
            "id": ID,
            "state": "queued" if request.method == "POST" else self._jobs,
            "progress": {"stage": "predict", "done": 1, "total": 2},
            "options": {"format": "ply"},
            "report": None,
            "problem": problem,
        }
        return httpx2.Response(200, json=record)


@pytest.mark.parametrize("name", ["dense.ply", "dense.dat", None])
def test_a_large_cloud_becomes_a_job(
    run_client: ClientRunner, ply_bytes: bytes, tmp_path: Path, name: str | None
) -> None:
    """The result of the job is that of the call, in memory or in the file."""
    out = None if name is None else tmp_path / name
    service = Service(ply_bytes, jobs="succeeded")
    stages: list[str] = []
    result = run_client(
        lambda client: client.upsample(
            b"cloud", out=out, format="ply", on_progress=lambda stage, *_: stages.append(stage)
        ),
        service,
    )
    assert service.calls == [
        "POST /upsample", "POST /jobs", f"GET /jobs/{ID}", f"GET /jobs/{ID}/result"
    ]  # fmt: skip
    assert service.bodies == [b"cloud"]
    assert (len(result), result.path) == (3, out)
    assert stages == ["send", "send", "predict", "receive"]
    assert out is None or out.read_bytes() == ply_bytes


@pytest.mark.parametrize(
    ("left", "calls"), [(590.0, 4), (599.5, 1), ("soon", 4)], ids=["service", "caller", "unknown"]
)
def test_a_cloud_that_is_refused_at_once(
    run_client: ClientRunner, ply_bytes: bytes, left: Any, calls: int
) -> None:
    """No job is made where the timeout of the call, and not the service, is the limit."""
    service = Service(ply_bytes, code="deadline_too_short", seconds_left=left, retryable=False)
    if calls == 1:
        with pytest.raises(ServerDeadlineError):
            run_client(lambda client: client.upsample(b"cloud"), service)
    else:
        assert len(run_client(lambda client: client.upsample(b"cloud"), service)) == 3
    assert len(service.calls) == calls


def test_no_time_for_a_job(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """With less than a second left the error of the request is raised."""
    service = Service(ply_bytes)
    with pytest.raises(ServerDeadlineError):
        run_client(lambda client: client.upsample(b"cloud", timeout=0.9), service)
    assert service.calls == ["POST /upsample"]


def test_a_pipe_cannot_be_sent_again(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """A source that was read is not submitted: the error of the request is raised."""

    class Pipe(io.BytesIO):
        def seekable(self) -> bool:
            return False

    service = Service(ply_bytes)
    with pytest.raises(ServerDeadlineError):
        run_client(lambda client: client.upsample(Pipe(b"cloud")), service)
    assert service.calls == ["POST /upsample"]


def test_a_service_without_jobs(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """If the job is refused, the error of the request is raised, with the refusal as its cause."""
    with pytest.raises(ServerDeadlineError) as caught:
        run_client(lambda client: client.upsample(b"cloud"), Service(ply_bytes, jobs="none"))
    assert "404" in str(caught.value.__cause__)


def test_a_job_that_fails(run_client: ClientRunner, ply_bytes: bytes) -> None:
    """Its error is that of the call, and its files are deleted."""
    service = Service(ply_bytes, jobs="failed")
    with pytest.raises(UnprocessableError):
        run_client(lambda client: client.upsample(b"cloud"), service)
    assert service.calls[-1] == f"DELETE /jobs/{ID}"


def test_a_job_that_takes_too_long(
    run_client: ClientRunner, ply_bytes: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the deadline of the call the job is cancelled: nobody knows its id."""
    clock = iter(range(100_000))
    for module in ("_client", "_aclient", "_attempts", "_job_record"):
        monkeypatch.setattr(f"pugeo_client.{module}.time.monotonic", lambda: next(clock) / 10)
    service = Service(ply_bytes, jobs="running")
    with pytest.raises(TimeoutError):
        run_client(lambda client: client.upsample(b"cloud", timeout=20), service)
    assert service.calls[-1] == f"DELETE /jobs/{ID}"
