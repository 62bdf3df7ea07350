# SPDX-License-Identifier: Apache-2.0
"""Jobs of both clients, against a function in the place of a service."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from pugeo_client.errors import (
    ConnectionFailedError,
    DeadlineExceededError,
    GoneError,
    NotFoundError,
    SourceError,
    UnavailableError,
    UnprocessableError,
)

ClientRunner = Callable[..., Any]
ID = "01a201f3ed23172a420e035311bb2554"


def report(state: str, *, done: int = 0, total: int | None = None, **more: Any) -> httpx2.Response:
    """A job as the service reports it."""
    job = {
        "id": ID,
        "state": state,
        "progress": {"stage": "predict", "done": done, "total": total},
        "options": {"format": "ply"},
        "report": None,
        "problem": None,
    }
    return httpx2.Response(200, json=job | more)


def problem(status: int, code: str, **headers: str) -> httpx2.Response:
    return httpx2.Response(status, headers=headers, json={"code": code, "detail": "why"})


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


def then(outcome: Any, follow: Callable[[Any], Any]) -> Any:
    """Apply a function to the result of a call of either client."""
    if hasattr(outcome, "__await__"):

        async def both() -> Any:
            given = follow(await outcome)
            return await given if hasattr(given, "__await__") else given

        return both()
    return follow(outcome)


def test_submit_sends_a_key(run_client: ClientRunner, tmp_path: Path) -> None:
    """The cloud is sent to /jobs with its options, and a retry has the same key."""
    (tmp_path / "in.ply").write_bytes(b"ply\n")
    service = ScriptedService(problem(503, "x"), report("queued"))
    job = run_client(lambda client: client.submit(tmp_path / "in.ply", ratio=8, seed=3), service)
    first, second = service.requests
    assert (first.method, first.url.path, first.content) == ("POST", "/jobs", b"ply\n")
    assert first.url.params["R"] == "8.0"
    assert first.url.params["seed"] == "3"
    assert first.headers["idempotency-key"] == second.headers["idempotency-key"] != ""
    assert "prefer" not in first.headers
    assert (job.id, job.state, job.finished) == (ID, "queued", False)


def test_two_submits_are_two_jobs(run_client: ClientRunner) -> None:
    """Without a given key each call has its own; a given one is sent unchanged."""
    service = ScriptedService(report("queued"))
    for key in (None, None, "mine"):
        run_client(lambda client, key=key: client.submit(b"ply\n", idempotency_key=key), service)
    keys = [request.headers["idempotency-key"] for request in service.requests]
    assert len(set(keys)) == 3
    assert keys[2] == "mine"


def test_submit_respects_retry_after(run_client: ClientRunner) -> None:
    """A submission waits as long as Retry-After asks, like every other call."""
    service = ScriptedService(problem(503, "jobs_full", **{"Retry-After": "7"}), report("queued"))
    run_client(lambda client: client.submit(b"ply\n"), service)
    assert 7 <= run_client.waits[0] < 8  # type: ignore[attr-defined]


def test_wait_reports_progress(run_client: ClientRunner) -> None:
    """Each change is reported once, pauses grow, and a job that has succeeded is returned."""
    states = [report("running", done=d, total=t) for d, t in ((0, None), (0, None), (1, 4))]
    service = ScriptedService(report("queued"), *states, report("succeeded", done=4, total=4))
    seen: list[tuple[str, int, int]] = []
    job = run_client(
        lambda client: then(
            client.job(ID), lambda job: job.wait(on_progress=lambda *now: seen.append(now))
        ),
        service,
    )
    assert seen == [("predict", 0, 0), ("predict", 1, 4), ("predict", 4, 4)]
    assert job.state == "succeeded"
    waits = run_client.waits  # type: ignore[attr-defined]
    assert waits == sorted(waits)


def test_wait_survives_a_restart(run_client: ClientRunner) -> None:
    """A service that is unreachable or not ready for a while does not end the wait."""
    gone: list[Any] = [httpx2.ConnectError("refused"), problem(503, "jobs_unavailable")]
    service = ScriptedService(report("running"), *gone, *gone, *gone, report("succeeded"))
    job = run_client(lambda client: then(client.job(ID), lambda job: job.wait()), service)
    assert job.state == "succeeded"


def test_wait_ends_at_its_timeout(
    run_client: ClientRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`timeout` ends the call and not the job; an outage of minutes is an error."""
    clock = iter(range(0, 100_000, 50))
    monkeypatch.setattr("pugeo_client._job_record.time.monotonic", lambda: float(next(clock)))
    with pytest.raises(DeadlineExceededError):
        run_client(
            lambda client: then(client.job(ID), lambda job: job.wait(timeout=1000)),
            ScriptedService(report("running")),
            timeout=1e6,
        )
    with pytest.raises(ConnectionFailedError):
        run_client(
            lambda client: then(client.job(ID), lambda job: job.wait()),
            ScriptedService(report("running"), httpx2.ConnectError("refused")),
            timeout=1e6,
        )


def test_a_failed_job_raises_its_problem(run_client: ClientRunner) -> None:
    """The error is that of `upsample`, with its fields."""
    why = {"status": 422, "code": "too_few_points", "detail": "why", "limit": 8, "request_id": "r"}
    service = ScriptedService(report("failed", problem=why))
    for call in ("wait", "result"):
        with pytest.raises(UnprocessableError) as caught:
            run_client(
                lambda client, call=call: then(client.job(ID), lambda j: getattr(j, call)()),
                service,
            )
        assert (caught.value.code, caught.value.fields) == ("too_few_points", {"limit": 8})
        assert caught.value.request_id == "r"


@pytest.mark.parametrize(
    ("state", "code"), [("cancelled", "job_cancelled"), ("expired", "result_gone")]
)
def test_a_job_without_a_result(run_client: ClientRunner, state: str, code: str) -> None:
    """Waiting for a cancelled or expired job ends with `GoneError`."""
    with pytest.raises(GoneError) as caught:
        run_client(
            lambda client: then(client.job(ID), lambda job: job.wait()),
            ScriptedService(report(state)),
        )
    assert caught.value.code == code


def test_the_result(run_client: ClientRunner, ply_bytes: bytes, tmp_path: Path) -> None:
    """The result is downloaded to memory or to a file after the job has succeeded."""
    dense = httpx2.Response(200, content=ply_bytes, headers={"Pugeo-Points-Out": "3"})
    service = ScriptedService(report("running"), report("succeeded"), dense)
    result = run_client(lambda client: then(client.job(ID), lambda job: job.result()), service)
    assert (len(result), result.meta.points_out) == (3, 3)
    assert service.requests[-1].url.path == f"/jobs/{ID}/result"
    service = ScriptedService(report("succeeded"), report("succeeded"), dense)
    out = tmp_path / "out.ply"
    result = run_client(lambda client: then(client.job(ID), lambda job: job.result(out)), service)
    assert out.read_bytes() == ply_bytes
    assert result.path == out


def test_a_file_of_another_format(run_client: ClientRunner, tmp_path: Path) -> None:
    """A result in PLY is not written into an .npz; nothing is requested."""
    service = ScriptedService(report("succeeded"))
    with pytest.raises(SourceError, match="format="):
        run_client(
            lambda client: then(client.job(ID), lambda job: job.result(tmp_path / "out.npz")),
            service,
        )
    assert len(service.requests) == 1
    assert not list(tmp_path.iterdir())


def test_cancel(run_client: ClientRunner) -> None:
    """Cancelling is a DELETE, and the job has the new state."""
    service = ScriptedService(report("running"), report("cancelled"))
    job = run_client(lambda client: then(client.job(ID), lambda job: job.cancel()), service)
    assert service.requests[-1].method == "DELETE"
    assert job.state == "cancelled"
    assert isinstance(job.error, GoneError)


def test_refresh(run_client: ClientRunner) -> None:
    """One request updates the state."""
    service = ScriptedService(report("queued"), report("running", done=1, total=2))
    job = run_client(lambda client: then(client.job(ID), lambda job: job.refresh()), service)
    assert job.progress == ("predict", 1, 2)


def test_jobs_reads_all_pages(run_client: ClientRunner) -> None:
    """All pages are read, each with the cursor of the one before."""
    page = {"jobs": [report("queued").json()], "next": "abc"}
    last = {"jobs": [report("running").json()], "next": None}
    service = ScriptedService(httpx2.Response(200, json=page), httpx2.Response(200, json=last))
    jobs = run_client(lambda client: client.jobs(state="queued"), service)
    assert [job.state for job in jobs] == ["queued", "running"]
    assert [request.url.params.get("cursor") for request in service.requests] == [None, "abc"]
    assert service.requests[0].url.params["state"] == "queued"


def test_an_unknown_job(run_client: ClientRunner) -> None:
    """An unknown id is `NotFoundError`, without a retry."""
    with pytest.raises(NotFoundError):
        run_client(
            lambda client: client.job("nothing"), ScriptedService(problem(404, "unknown_job"))
        )
    assert run_client.waits == []  # type: ignore[attr-defined]


def test_a_permanent_error_while_waiting(run_client: ClientRunner) -> None:
    """A wait ends with an error that is not transient."""
    service = ScriptedService(report("running"), problem(404, "unknown_job"))
    with pytest.raises(NotFoundError):
        run_client(lambda client: then(client.job(ID), lambda job: job.wait()), service)
    with pytest.raises(UnavailableError):
        run_client(lambda client: client.job(ID), ScriptedService(problem(503, "x")), max_retries=0)
