# SPDX-License-Identifier: Apache-2.0
"""Jobs of both clients, against a service that is played by a function."""

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

Twin = Callable[..., Any]
ID = "01a201f3ed23172a420e035311bb2554"


def told(state: str, *, done: int = 0, total: int | None = None, **more: Any) -> httpx2.Response:
    """A job as the service tells it."""
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


class Played:
    """Gives the next of its answers to each request; the last one for ever."""

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
    """Do something with what a call of either client gives."""
    if hasattr(outcome, "__await__"):

        async def both() -> Any:
            given = follow(await outcome)
            return await given if hasattr(given, "__await__") else given

        return both()
    return follow(outcome)


def test_submit_names_its_request(twin: Twin, tmp_path: Path) -> None:
    """The cloud goes to /jobs with its options, and a retry carries the same key."""
    (tmp_path / "in.ply").write_bytes(b"ply\n")
    service = Played(problem(503, "x"), told("queued"))
    job = twin(lambda client: client.submit(tmp_path / "in.ply", ratio=8, seed=3), service)
    first, second = service.requests
    assert (first.method, first.url.path, first.content) == ("POST", "/jobs", b"ply\n")
    assert first.url.params["R"] == "8.0"
    assert first.url.params["seed"] == "3"
    assert first.headers["idempotency-key"] == second.headers["idempotency-key"] != ""
    assert "prefer" not in first.headers
    assert (job.id, job.state, job.finished) == (ID, "queued", False)


def test_two_submits_are_two_jobs(twin: Twin) -> None:
    """Without a key of one's own each call has another; with one it is sent as it is."""
    service = Played(told("queued"))
    for key in (None, None, "mine"):
        twin(lambda client, key=key: client.submit(b"ply\n", idempotency_key=key), service)
    keys = [request.headers["idempotency-key"] for request in service.requests]
    assert len(set(keys)) == 3
    assert keys[2] == "mine"


def test_a_service_that_is_full_is_asked_again(twin: Twin) -> None:
    """A submit waits as long as Retry-After says, as every other call does."""
    service = Played(problem(503, "jobs_full", **{"Retry-After": "7"}), told("queued"))
    twin(lambda client: client.submit(b"ply\n"), service)
    assert 7 <= twin.waits[0] < 8  # type: ignore[attr-defined]


def test_wait_tells_progress(twin: Twin) -> None:
    """Each change is told once, pauses grow, and the job is returned when it has succeeded."""
    states = [told("running", done=d, total=t) for d, t in ((0, None), (0, None), (1, 4))]
    service = Played(told("queued"), *states, told("succeeded", done=4, total=4))
    seen: list[tuple[str, int, int]] = []
    job = twin(
        lambda client: then(
            client.job(ID), lambda job: job.wait(on_progress=lambda *now: seen.append(now))
        ),
        service,
    )
    assert seen == [("predict", 0, 0), ("predict", 1, 4), ("predict", 4, 4)]
    assert job.state == "succeeded"
    waits = twin.waits  # type: ignore[attr-defined]
    assert waits == sorted(waits)


def test_wait_outlives_a_restart(twin: Twin) -> None:
    """A service that is gone, or not ready, for a while does not end the waiting."""
    gone: list[Any] = [httpx2.ConnectError("refused"), problem(503, "jobs_unavailable")]
    service = Played(told("running"), *gone, *gone, *gone, told("succeeded"))
    job = twin(lambda client: then(client.job(ID), lambda job: job.wait()), service)
    assert job.state == "succeeded"


def test_wait_has_an_end(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> None:
    """After `timeout` the call ends and the job goes on; a service gone for minutes is an error."""
    clock = iter(range(0, 100_000, 50))
    monkeypatch.setattr("pugeo_client._job.time.monotonic", lambda: float(next(clock)))
    with pytest.raises(DeadlineExceededError):
        twin(
            lambda client: then(client.job(ID), lambda job: job.wait(timeout=1000)),
            Played(told("running")),
            timeout=1e6,
        )
    with pytest.raises(ConnectionFailedError):
        twin(
            lambda client: then(client.job(ID), lambda job: job.wait()),
            Played(told("running"), httpx2.ConnectError("refused")),
            timeout=1e6,
        )


def test_a_failed_job_raises_its_problem(twin: Twin) -> None:
    """The error is the one that `upsample` would have raised, with its fields."""
    why = {"status": 422, "code": "too_few_points", "detail": "why", "limit": 8, "request_id": "r"}
    service = Played(told("failed", problem=why))
    for call in ("wait", "result"):
        with pytest.raises(UnprocessableError) as caught:
            twin(
                lambda client, call=call: then(client.job(ID), lambda j: getattr(j, call)()),
                service,
            )
        assert (caught.value.code, caught.value.fields) == ("too_few_points", {"limit": 8})
        assert caught.value.request_id == "r"


@pytest.mark.parametrize(
    ("state", "code"), [("cancelled", "job_cancelled"), ("expired", "result_gone")]
)
def test_a_job_without_a_result(twin: Twin, state: str, code: str) -> None:
    """Waiting for one that was cancelled or has expired ends with `GoneError`."""
    with pytest.raises(GoneError) as caught:
        twin(lambda client: then(client.job(ID), lambda job: job.wait()), Played(told(state)))
    assert caught.value.code == code


def test_the_result(twin: Twin, ply_bytes: bytes, tmp_path: Path) -> None:
    """It is fetched in memory or to a file, once the job has succeeded."""
    dense = httpx2.Response(200, content=ply_bytes, headers={"Pugeo-Points-Out": "3"})
    service = Played(told("running"), told("succeeded"), dense)
    result = twin(lambda client: then(client.job(ID), lambda job: job.result()), service)
    assert (len(result), result.meta.points_out) == (3, 3)
    assert service.requests[-1].url.path == f"/jobs/{ID}/result"
    service = Played(told("succeeded"), told("succeeded"), dense)
    out = tmp_path / "out.ply"
    result = twin(lambda client: then(client.job(ID), lambda job: job.result(out)), service)
    assert out.read_bytes() == ply_bytes
    assert result.path == out


def test_a_file_of_another_format(twin: Twin, tmp_path: Path) -> None:
    """What was submitted for PLY is not written into an .npz, and nothing is asked."""
    service = Played(told("succeeded"))
    with pytest.raises(SourceError, match="format="):
        twin(
            lambda client: then(client.job(ID), lambda job: job.result(tmp_path / "out.npz")),
            service,
        )
    assert len(service.requests) == 1
    assert not list(tmp_path.iterdir())


def test_cancel(twin: Twin) -> None:
    """It is a DELETE, and the job knows what became of it."""
    service = Played(told("running"), told("cancelled"))
    job = twin(lambda client: then(client.job(ID), lambda job: job.cancel()), service)
    assert service.requests[-1].method == "DELETE"
    assert job.state == "cancelled"
    assert isinstance(job.error, GoneError)


def test_refresh(twin: Twin) -> None:
    """It asks once and tells the new state."""
    service = Played(told("queued"), told("running", done=1, total=2))
    job = twin(lambda client: then(client.job(ID), lambda job: job.refresh()), service)
    assert job.progress == ("predict", 1, 2)


def test_jobs_turns_pages(twin: Twin) -> None:
    """All pages are read, each with the cursor of the one before."""
    page = {"jobs": [told("queued").json()], "next": "abc"}
    last = {"jobs": [told("running").json()], "next": None}
    service = Played(httpx2.Response(200, json=page), httpx2.Response(200, json=last))
    jobs = twin(lambda client: client.jobs(state="queued"), service)
    assert [job.state for job in jobs] == ["queued", "running"]
    assert [request.url.params.get("cursor") for request in service.requests] == [None, "abc"]
    assert service.requests[0].url.params["state"] == "queued"


def test_a_job_that_is_not_there(twin: Twin) -> None:
    """An unknown id is `NotFoundError`, at once."""
    with pytest.raises(NotFoundError):
        twin(lambda client: client.job("nothing"), Played(problem(404, "unknown_job")))
    assert twin.waits == []  # type: ignore[attr-defined]


def test_a_poll_that_will_not_pass(twin: Twin) -> None:
    """Waiting ends where the answer is no matter of time."""
    service = Played(told("running"), problem(404, "unknown_job"))
    with pytest.raises(NotFoundError):
        twin(lambda client: then(client.job(ID), lambda job: job.wait()), service)
    with pytest.raises(UnavailableError):
        twin(lambda client: client.job(ID), Played(problem(503, "x")), max_retries=0)
