# SPDX-License-Identifier: Apache-2.0
"""The life of a job, from 202 to its end."""

import asyncio
import hashlib
from typing import Any

import numpy as np
import pytest

from pugeo_model.errors import MalformedFileError


def test_a_job_from_beginning_to_end(play: Any) -> None:
    """It is accepted, runs with its options in the background, and has result and report."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post("/jobs?R=2&seed=5&format=xyz", content=b"cloud")
        assert answer.status_code == 202
        job = answer.json()
        assert answer.headers["location"] == f"/jobs/{job['id']}"
        assert answer.headers["retry-after"] == "1"
        assert job["options"]["seed"] == 5
        assert job["input"] == {"bytes": 5, "sha256": hashlib.sha256(b"cloud").hexdigest()}
        assert job["request_id"] == answer.headers["x-request-id"]
        done = await house.until(job["id"], "succeeded")
        assert done["progress"] == {"stage": "done", "done": 4, "total": 4}
        assert done["report"]["dropped"] == {"non_finite": 1, "duplicate": 2}
        assert done["created_at"] <= done["started_at"] <= done["finished_at"] < done["expires_at"]
        order = house.engine.orders[0]
        assert (order.background, order.answer, order.options["seed"]) == (True, "xyz", 5)
        result = await house.http.get(f"/jobs/{job['id']}/result")
        assert result.content == b"dense cloudcloud"
        assert result.headers["content-type"].startswith("text/plain")
        await house.eventually(lambda: house.names("inputs") == [])
        assert house.names("parts") == []
        assert house.names("results") == [job["id"]]

    play(scenario)


def test_progress_is_told(play: Any) -> None:
    """While it runs, the job tells its stage and its patches, and its result is a 409."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        running = await house.until(job["id"], "running")
        while running["progress"]["total"] is None:
            running = await house.get(job["id"])
        assert running["progress"] == {"stage": "predict", "done": 1, "total": 4}
        early = await house.http.get(f"/jobs/{job['id']}/result")
        assert (early.status_code, early.json()["code"]) == (409, "job_not_finished")
        assert early.json()["retryable"] is True
        house.engine.hold.set()
        await house.until(job["id"], "succeeded")

    play(scenario)


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [(b"malformed", 400, "malformed_file"), (b"poison", 422, "worker_lost"),
     (b"bug", 500, "internal_error")],
)  # fmt: skip
def test_a_job_that_fails(play: Any, body: bytes, status: int, code: str) -> None:
    """The problem is that of /upsample, in the job and at its result; nothing stays on disk."""

    async def scenario(house: Any) -> None:
        job = await house.submit(body)
        failed = await house.until(job["id"], "failed")
        problem = failed["problem"]
        assert (problem["status"], problem["code"]) == (status, code)
        assert problem["request_id"] == job["request_id"]
        assert problem["instance"] == f"/jobs/{job['id']}"
        result = await house.http.get(f"/jobs/{job['id']}/result")
        assert (result.status_code, result.json()["code"]) == (status, code)
        assert result.json()["job"] == job["id"]
        await house.eventually(lambda: house.names("inputs") == [])
        assert len(house.engine.began) == 1

    play(scenario)


def test_a_job_of_malformed_bytes_tells_where(play: Any) -> None:
    """Members that the model adds to an error reach the client."""

    async def scenario(house: Any) -> None:
        job = await house.submit(b"malformed")
        assert (await house.until(job["id"], "failed"))["problem"]["row"] == 7

    play(scenario)


def test_an_engine_that_is_gone_is_waited_for(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lost scheduler is no fault of the job: it goes back into the queue, uncounted."""
    monkeypatch.setattr("pugeo_service.jobs.completion._ENGINE_BACK_S", 0.1)

    async def scenario(house: Any) -> None:
        house.engine.lose = 7  # more often than a job may be begun
        job = await house.submit()
        done = await house.until(job["id"], "succeeded", "failed")
        assert (done["state"], done["attempts"]) == ("succeeded", 1)
        assert len(house.engine.began) == 8

    play(scenario)


def test_a_few_at_a_time_in_order(play: Any) -> None:
    """No more run than the setting says, and who came first begins first."""

    async def scenario(house: Any) -> None:
        bodies = [b"cloud %d" % number for number in range(6)]
        ids = [(await house.submit(body))["id"] for body in bodies]
        for job_id in ids:
            await house.until(job_id, "succeeded")
        assert house.engine.most_running <= 2
        assert house.engine.began[:2] == bodies[:2]
        assert sorted(house.engine.began) == bodies

    play(scenario, jobs_running=2)


def test_jobs_keep_no_request_out(play: Any) -> None:
    """While jobs fill their own account of the queue, /upsample is served."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        ids = [(await house.submit(b"cloud %d" % number))["id"] for number in range(3)]
        await house.until(ids[0], "running")
        health = (await house.http.get("/health")).json()
        assert (health["status"], health["queue_requests"]) == ("ready", 0)
        call = asyncio.create_task(house.http.post("/upsample?R=2", content=b"small"))
        await house.eventually(lambda: b"small" in house.engine.began)
        house.engine.hold.set()
        assert (await call).status_code == 200
        for job_id in ids:
            await house.until(job_id, "succeeded")

    play(scenario, jobs_running=2, queue_patches=4, queue_requests=1)


def test_a_job_waits_for_the_patches_of_another(play: Any) -> None:
    """One that leaves no room keeps the next waiting, and does not make it fail."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        first = await house.submit(b"first")
        await house.eventually(lambda: house.jobs.admission.patches >= 3)
        second = await house.submit(b"second")
        assert (await house.until(second["id"], "running", "failed"))["state"] == "running"
        await asyncio.sleep(0.1)
        assert house.engine.began == [b"first"]
        house.engine.hold.set()
        for job in (first, second):
            await house.until(job["id"], "succeeded")

    play(scenario, jobs_running=2, queue_patches=3)


def test_an_error_with_strange_numbers(play: Any) -> None:
    """Those of numpy, those that are none and those of many digits end a job as any others."""

    async def scenario(house: Any) -> None:
        def go_wrong(_: bytes) -> None:
            raise MalformedFileError("broken", value=10**30, limit=np.int64(3), mean=float("nan"))

        house.engine._go_wrong = go_wrong
        job = await house.submit()
        failed = await house.until(job["id"], "failed")
        answer = await house.http.get(f"/jobs/{job['id']}/result")
        assert answer.status_code == 400
        for problem in (failed["problem"], answer.json()):
            assert (problem["value"], problem["limit"], problem["mean"]) == (10**30, 3, None)

    play(scenario)


def test_a_job_has_a_deadline(play: Any) -> None:
    """One that runs too long fails with 504, and the next one is begun."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        failed = await house.until(job["id"], "failed")
        assert failed["problem"]["code"] == "deadline_exceeded"
        assert failed["problem"]["limit"] == 0.2
        assert house.engine.running == 0

    play(scenario, jobs_deadline_s=0.2, jobs_running=1)


def test_options_are_checked_before_the_202(play: Any) -> None:
    """What /upsample refuses at once is refused at once here, and leaves nothing behind."""

    async def scenario(house: Any) -> None:
        cases: list[tuple[str, bytes, dict[str, str], int, str]] = [
            ("?R=64", b"x", {}, 422, "bad_option"),
            ("?what=1", b"x", {}, 422, "bad_option"),
            ("", b"", {}, 400, "empty_body"),
            ("", b"x", {"Content-Type": "image/png"}, 415, "unsupported_media_type"),
            ("", b"x", {"Accept": "image/png"}, 406, "not_acceptable"),
            ("", b"x" * 1001, {}, 413, "body_too_large"),
            ("", b"x", {"Idempotency-Key": " "}, 400, "bad_idempotency_key"),
            ("", b"x", {"Idempotency-Key": "k" * 256}, 400, "bad_idempotency_key"),
        ]
        for query, body, headers, status, code in cases:
            answer = await house.http.post(f"/jobs{query}", content=body, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
        assert house.names("inputs") == house.names("parts") == []
        assert (await house.http.get("/jobs")).json()["jobs"] == []

    play(scenario, max_body_bytes=1000)


def test_metrics(play: Any) -> None:
    """Each state is counted once, and what is active is a gauge."""

    async def scenario(house: Any) -> None:
        good = await house.submit()
        bad = await house.submit(b"malformed")
        await house.until(good["id"], "succeeded")
        await house.until(bad["id"], "failed")
        await house.http.delete(f"/jobs/{good['id']}")
        page = (await house.http.get("/metrics")).text
        for state, count in {"queued": 2, "succeeded": 1, "failed": 1, "expired": 1}.items():
            assert f'pugeo_jobs_total{{state="{state}"}} {count}.0' in page
        assert 'pugeo_jobs_active{state="running"}' in page
        assert 'pugeo_points_total{direction="out"} 8.0' in page

    play(scenario)
