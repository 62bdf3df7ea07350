# SPDX-License-Identifier: Apache-2.0
"""Jobs on a real service: crashes, shutdowns, events, ranges, cancellation, the SDK."""

import asyncio
import hashlib
import io
import json
import random
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest
from tests.http_client import HTTP

from pugeo_client import AsyncClient, Client
from pugeo_client.errors import GoneError, UnprocessableError
from pugeo_model import Cloud, formats

# Several services are started and killed.
pytestmark = pytest.mark.slow


class Server(Protocol):
    """Value of the fixture `server`."""

    url: str
    process: Any

    def workers(self) -> list[Any]: ...
    def wait_until_ready(self) -> None: ...
    def wait_until_working(self) -> None: ...
    def metric(self, sample: str) -> float: ...
    def stop(self) -> int: ...


def ball(count: int) -> bytes:
    """A sphere of so many points, as a PLY file."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


SMALL, MIDDLE, LARGE = ball(1500), ball(9000), ball(100_000)
# It takes more than a second on any machine; progress is stored every half second.
LONG = ball(40_000)


def eventually(check: Callable[[], bool], seconds: float = 300.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end
        time.sleep(0.05)


def ended(workers: list[Any]) -> None:
    """Wait until these processes are gone."""
    eventually(lambda: not any(worker.is_running() for worker in workers))


def submit(server: Server, body: bytes, query: str = "?R=2", key: str | None = None) -> str:
    """Submit a job and return its id."""
    headers = {} if key is None else {"Idempotency-Key": key}
    answer = HTTP.post(f"{server.url}/jobs{query}", content=body, headers=headers, timeout=60)
    assert answer.status_code in {200, 202}, answer.text
    return str(answer.json()["id"])


def state(server: Server, job_id: str) -> str:
    """The state of a job."""
    return str(HTTP.get(f"{server.url}/jobs/{job_id}", timeout=30).json()["state"])


def finish(server: Server, job_id: str) -> bytes:
    """Wait for the result of a job."""
    eventually(lambda: state(server, job_id) in {"succeeded", "failed"})
    answer = HTTP.get(f"{server.url}/jobs/{job_id}/result", timeout=60)
    assert answer.status_code == 200, answer.text
    return answer.content


@contextmanager
def begun(server: Server) -> Iterator[str]:
    """A job some of whose patches are finished; cancelled at the end."""
    job_id = submit(server, LARGE)
    server.wait_until_working()
    try:
        yield job_id
    finally:
        HTTP.delete(f"{server.url}/jobs/{job_id}", timeout=30)


@pytest.mark.parametrize(
    ("kills", "count"),
    [(1, "1"), pytest.param(8, "2", marks=[pytest.mark.long, pytest.mark.timeout(1200)])],
)
def test_killed_at_any_moment(
    launch: Any, server: Server, tmp_path: Path, kills: int, count: str
) -> None:
    """After SIGKILL at random times each job is finished once, with the bytes of /upsample."""
    chance = random.Random(kills)
    clouds = {f"job {n}": (body, f"?R=2&seed={n}") for n, body in enumerate([MIDDLE, SMALL, SMALL])}
    ids: dict[str, set[str]] = {name: set() for name in clouds}
    folder = str(tmp_path / "jobs")
    options = ("--workers", count)
    # More attempts than crashes, because a job may run at each crash.
    environment = {"PUGEO_JOBS_DIR": folder, "PUGEO_JOBS_ATTEMPTS": "100"}
    for _ in range(kills):
        with launch(*options, **environment) as one:
            one.wait_until_ready()
            for name, (body, query) in clouds.items():
                ids[name].add(submit(one, body, query, key=name))
            time.sleep(chance.uniform(0, 3))
            workers = one.workers()
            one.process.kill()
            one.process.wait()
            # Workers end by themselves, and hold no resource of the next service.
            ended(workers)
    with launch(*options, **environment) as last:
        last.wait_until_ready()
        for name, (body, query) in clouds.items():
            assert len(ids[name]) == 1
            expected = HTTP.post(f"{server.url}/upsample{query}", content=body, timeout=60)
            assert finish(last, next(iter(ids[name]))) == expected.content
        assert len(HTTP.get(f"{last.url}/jobs", timeout=60).json()["jobs"]) == len(clouds)
        eventually(lambda: not list((tmp_path / "jobs" / "inputs").iterdir()))
        assert list((tmp_path / "jobs" / "parts").iterdir()) == []
        assert last.stop() == 0


def test_a_drain_queues_jobs_again_and_ends_streams(launch: Any, tmp_path: Path) -> None:
    """SIGTERM ends streams and the process with status 0; the job is finished after a restart."""
    folder = str(tmp_path / "jobs")
    options = ("--workers", "1", "--drain-s", "300")
    with launch(*options, SLOW_S="0.5", PUGEO_JOBS_DIR=folder) as one:
        one.wait_until_ready()
        job_id = submit(one, ball(14_000))
        eventually(lambda: one.metric('pugeo_queue_patches{queue="jobs"}') > 4)
        with HTTP.stream("GET", f"{one.url}/jobs/{job_id}/events", timeout=60) as events:
            lines = events.iter_lines()
            assert next(lines).startswith("retry:")
            one.process.send_signal(signal.SIGTERM)
            assert "event: end" not in list(lines)
        assert one.process.wait(300) == 0
        assert "job queued again" in one.log.read_text()
    with launch("--workers", "1", PUGEO_JOBS_DIR=folder) as other:
        other.wait_until_ready()
        dense = formats.read(io.BytesIO(finish(other, job_id)), format="ply")
        assert len(dense.points) == 28_000
        job = HTTP.get(f"{other.url}/jobs/{job_id}", timeout=60).json()
        assert job["attempts"] == 1


def test_events_and_ranges(server: Server) -> None:
    """Events of a job until its end, and its result whole, in ranges, or not modified."""
    job_id = submit(server, LONG, "?R=4")
    names, last = [], {}
    with HTTP.stream("GET", f"{server.url}/jobs/{job_id}/events", timeout=100) as events:
        for line in events.iter_lines():
            field, _, value = line.partition(": ")
            if field == "event":
                names.append(value)
            elif field == "data":
                last = json.loads(value)
    assert names[0] == "state"
    assert "progress" in names
    assert names[-1] == "end"
    assert last["state"] == "succeeded"
    assert last["report"]["points_out"] == 160_000
    url = f"{server.url}/jobs/{job_id}/result"
    whole = HTTP.get(url, timeout=60)
    etag = whole.headers["etag"]
    assert etag == f'"{hashlib.sha256(whole.content).hexdigest()}"'
    parts = [
        HTTP.get(
            url, headers={"Range": f"bytes={start}-{start + 999_999}", "If-Range": etag}, timeout=60
        )
        for start in range(0, len(whole.content), 1_000_000)
    ]
    assert {part.status_code for part in parts} == {206}
    assert b"".join(part.content for part in parts) == whole.content
    assert HTTP.get(url, headers={"If-None-Match": etag}, timeout=60).status_code == 304
    outside = HTTP.get(url, headers={"Range": f"bytes={len(whole.content)}-"}, timeout=60)
    assert outside.status_code == 416


def test_a_cancelled_job_frees_its_patches(server: Server) -> None:
    """The patches of a cancelled job leave the queue, and its result is a 410."""
    with begun(server) as job_id:
        answer = HTTP.delete(f"{server.url}/jobs/{job_id}", timeout=30)
        assert answer.json()["state"] == "cancelled"
        eventually(lambda: server.metric('pugeo_queue_patches{queue="jobs"}') == 0)
        gone = HTTP.get(f"{server.url}/jobs/{job_id}/result", timeout=60)
        assert (gone.status_code, gone.json()["code"]) == (410, "job_cancelled")


def test_jobs_do_not_hold_up_small_requests(server: Server) -> None:
    """Small requests are answered while a large job is running."""
    with begun(server) as job_id:
        for _ in range(3):
            answer = HTTP.post(f"{server.url}/upsample?R=2", content=SMALL, timeout=300)
            assert answer.status_code == 200
        assert state(server, job_id) == "running"


def test_the_sdk(server: Server, tmp_path: Path) -> None:
    """The SDK submits, watches, fetches, lists and cancels jobs; errors are typed."""
    seen: list[tuple[str, int, int]] = []
    with Client(server.url) as client:
        job = client.submit("examples/block.ply", ratio=2, idempotency_key=f"sdk {tmp_path}")
        again = client.submit("examples/block.ply", ratio=2, idempotency_key=f"sdk {tmp_path}")
        assert again.id == job.id
        dense = job.result(tmp_path / "dense.ply", on_progress=lambda *now: seen.append(now))
        assert dense.meta.points_out == len(dense.points)
        assert job.report is not None
        assert job.report["points_out"] == len(dense)
        assert seen[-1][0] == "receive"
        assert client.job(job.id).state == "succeeded"
        assert job.id in {found.id for found in client.jobs(state="succeeded")}
        with pytest.raises(GoneError):
            job.cancel().wait()
        with pytest.raises(UnprocessableError) as caught:
            client.submit(np.zeros((100, 3))).wait()
        assert caught.value.request_id


def test_the_asynchronous_sdk(server: Server) -> None:
    """The asynchronous SDK submits, fetches and lists jobs."""

    async def whole() -> None:
        async with AsyncClient(server.url) as client:
            job = await client.submit(SMALL, ratio=2, format="npz")
            dense = await job.result(timeout=100)
            assert dense.points.shape == (3000, 3)
            assert job.id in [found.id async for found in client.jobs()]

    asyncio.run(whole())
