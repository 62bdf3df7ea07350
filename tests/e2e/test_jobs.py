# SPDX-License-Identifier: Apache-2.0
"""Jobs on a real service with real workers: killed, drained, watched, fetched in parts."""

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

import httpx2
import numpy as np
import pytest

from pugeo_client import AsyncClient, Client
from pugeo_client.errors import GoneError, UnprocessableError
from pugeo_model import Cloud, formats

# Services are started and killed here again and again.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


class Server(Protocol):
    """What the fixture `server` gives."""

    url: str
    process: Any

    def workers(self) -> list[Any]: ...
    def wait_until_ready(self) -> None: ...
    def metric(self, sample: str) -> float: ...
    def stop(self) -> int: ...


def ball(count: int) -> bytes:
    """A sphere of so many points, as a PLY file."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


SMALL, MIDDLE, LARGE = ball(1500), ball(9000), ball(200_000)
# Takes more than a second anywhere: progress is looked for every half second.
LONG = ball(60_000)


def eventually(check: Callable[[], bool], seconds: float = 90.0) -> float:
    """Wait until something is true; return the seconds it took."""
    start = time.monotonic()
    while not check():
        assert time.monotonic() - start < seconds
        time.sleep(0.05)
    return time.monotonic() - start


def ended(workers: list[Any]) -> None:
    """Wait until these processes are gone."""
    eventually(lambda: not any(worker.is_running() for worker in workers))


def submit(server: Server, body: bytes, query: str = "?R=2", key: str | None = None) -> str:
    """Submit a job and return its id."""
    headers = {} if key is None else {"Idempotency-Key": key}
    answer = httpx2.post(f"{server.url}/jobs{query}", content=body, headers=headers, timeout=60)
    assert answer.status_code in {200, 202}, answer.text
    return str(answer.json()["id"])


def state(server: Server, job_id: str) -> str:
    """The state of a job."""
    return str(httpx2.get(f"{server.url}/jobs/{job_id}", timeout=30).json()["state"])


def finish(server: Server, job_id: str) -> bytes:
    """Wait for the result of a job."""
    eventually(lambda: state(server, job_id) in {"succeeded", "failed"}, 110)
    answer = httpx2.get(f"{server.url}/jobs/{job_id}/result", timeout=60)
    assert answer.status_code == 200, answer.text
    return answer.content


@contextmanager
def begun(server: Server) -> Iterator[str]:
    """A job whose patches are being worked on; cancelled at the end."""
    job_id = submit(server, LARGE)
    eventually(lambda: server.metric("pugeo_queue_patches") > 4)
    time.sleep(2)
    try:
        yield job_id
    finally:
        httpx2.delete(f"{server.url}/jobs/{job_id}", timeout=30)


@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kills", [1, pytest.param(8, marks=pytest.mark.long)])
def test_killed_at_any_moment(launch: Any, server: Server, tmp_path: Path, kills: int) -> None:
    """Every accepted job is done once, with the bytes of /upsample, however often -9 strikes."""
    chance = random.Random(kills)
    clouds = {f"job {n}": (body, f"?R=2&seed={n}") for n, body in enumerate([MIDDLE, SMALL, SMALL])}
    ids: dict[str, set[str]] = {name: set() for name in clouds}
    folder = str(tmp_path / "jobs")
    for _ in range(kills):
        # So many ends would be held against a job that happens to run at each of them.
        with launch(PUGEO_JOBS_DIR=folder, PUGEO_JOBS_ATTEMPTS="100") as one:
            one.wait_until_ready()
            for name, (body, query) in clouds.items():
                ids[name].add(submit(one, body, query, key=name))
            time.sleep(chance.uniform(0, 3))
            workers = one.workers()
            one.process.kill()
            one.process.wait()
            # They end by themselves, and hold nothing that the next service would miss.
            ended(workers)
    with launch(PUGEO_JOBS_DIR=folder, PUGEO_JOBS_ATTEMPTS="100") as last:
        last.wait_until_ready()
        for name, (body, query) in clouds.items():
            assert len(ids[name]) == 1
            expected = httpx2.post(f"{server.url}/upsample{query}", content=body, timeout=60)
            assert finish(last, next(iter(ids[name]))) == expected.content
        assert len(httpx2.get(f"{last.url}/jobs").json()["jobs"]) == len(clouds)
        eventually(lambda: not list((tmp_path / "jobs" / "inputs").iterdir()))
        assert list((tmp_path / "jobs" / "parts").iterdir()) == []
        assert last.stop() == 0


def test_a_drain_parks_jobs_and_ends_streams(launch: Any, tmp_path: Path) -> None:
    """SIGTERM with a large job and an open stream: status 0 within seconds; done after restart."""
    folder = str(tmp_path / "jobs")
    with launch("--drain-s", "60", PUGEO_JOBS_DIR=folder) as one:
        one.wait_until_ready()
        job_id = submit(one, LARGE)
        eventually(lambda: one.metric("pugeo_queue_patches") > 4)
        with httpx2.stream("GET", f"{one.url}/jobs/{job_id}/events", timeout=60) as events:
            lines = events.iter_lines()
            assert next(lines).startswith("retry:")
            start = time.monotonic()
            one.process.send_signal(signal.SIGTERM)
            assert "event: end" not in list(lines)
        assert one.process.wait(60) == 0
        assert time.monotonic() - start < 30
        assert "job parked" in one.log.read_text()
    with launch(PUGEO_JOBS_DIR=folder) as other:
        other.wait_until_ready()
        dense = formats.read(io.BytesIO(finish(other, job_id)), format="ply")
        assert len(dense.points) == 400_000
        job = httpx2.get(f"{other.url}/jobs/{job_id}").json()
        assert job["attempts"] == 1


def test_events_and_ranges(server: Server) -> None:
    """The stream tells the way of a job to its end; its result comes whole, in parts, or not."""
    job_id = submit(server, LONG, "?R=4")
    names, last = [], {}
    with httpx2.stream("GET", f"{server.url}/jobs/{job_id}/events", timeout=100) as events:
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
    assert last["report"]["points_out"] == 240_000
    url = f"{server.url}/jobs/{job_id}/result"
    whole = httpx2.get(url)
    etag = whole.headers["etag"]
    assert etag == f'"{hashlib.sha256(whole.content).hexdigest()}"'
    parts = [
        httpx2.get(url, headers={"Range": f"bytes={start}-{start + 999_999}", "If-Range": etag})
        for start in range(0, len(whole.content), 1_000_000)
    ]
    assert {part.status_code for part in parts} == {206}
    assert b"".join(part.content for part in parts) == whole.content
    assert httpx2.get(url, headers={"If-None-Match": etag}).status_code == 304
    outside = httpx2.get(url, headers={"Range": f"bytes={len(whole.content)}-"})
    assert outside.status_code == 416


def test_a_cancelled_job_frees_its_patches(server: Server) -> None:
    """They leave the queue within the time of a few, and its files go."""
    with begun(server) as job_id:
        answer = httpx2.delete(f"{server.url}/jobs/{job_id}", timeout=30)
        assert answer.json()["state"] == "cancelled"
        assert eventually(lambda: server.metric("pugeo_queue_patches") == 0) < 2
        gone = httpx2.get(f"{server.url}/jobs/{job_id}/result")
        assert (gone.status_code, gone.json()["code"]) == (410, "job_cancelled")


def test_jobs_do_not_hold_up_small_requests(server: Server) -> None:
    """Who waits on the line goes first, while a large job has most of its way to go."""
    with begun(server) as job_id:
        for _ in range(3):
            start = time.monotonic()
            answer = httpx2.post(f"{server.url}/upsample?R=2", content=SMALL, timeout=60)
            assert answer.status_code == 200
            assert time.monotonic() - start < 5
        assert state(server, job_id) == "running"


def test_the_sdk(server: Server, tmp_path: Path) -> None:
    """Submit, watch, fetch, list, cancel; a cloud that cannot be used raises what it would have."""
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
    """The same, awaited."""

    async def whole() -> None:
        async with AsyncClient(server.url) as client:
            job = await client.submit(SMALL, ratio=2, format="npz")
            dense = await job.result(timeout=100)
            assert dense.points.shape == (3000, 3)
            assert job.id in [found.id async for found in client.jobs()]

    asyncio.run(whole())
