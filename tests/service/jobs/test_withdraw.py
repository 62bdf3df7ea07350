# SPDX-License-Identifier: Apache-2.0
"""DELETE: cancelling jobs and deleting results."""

import asyncio
from typing import Any

import pytest

from pugeo_service.jobs.completion import Completion
from pugeo_service.jobs.models import Job


def test_cancelling_what_waits(play: Any) -> None:
    """A cancelled queued job never starts, and its input is removed at once."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        first, second = await house.submit(b"one"), await house.submit(b"two")
        await house.until(first["id"], "running")
        answer = await house.http.delete(f"/jobs/{second['id']}")
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
        assert house.names("inputs") == [first["id"]]
        house.engine.hold.set()
        await house.until(first["id"], "succeeded")
        assert house.engine.began == [b"one"]

    play(scenario, jobs_running=1)


def test_cancelling_what_runs(play: Any) -> None:
    """A cancelled running job ends, frees its patches and files, and the next one starts."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        first, second = await house.submit(b"one"), await house.submit(b"two")
        await house.until(first["id"], "running")
        await house.eventually(lambda: house.jobs.admission.patches > 0)
        assert (await house.http.delete(f"/jobs/{first['id']}")).json()["state"] == "cancelled"
        await house.until(second["id"], "running")
        await house.eventually(lambda: house.names("inputs") == [second["id"]])
        await house.eventually(lambda: house.engine.running == 1)
        result = await house.http.get(f"/jobs/{first['id']}/result")
        assert (result.status_code, result.json()["code"]) == (410, "job_cancelled")
        house.engine.hold.set()
        await house.until(second["id"], "succeeded")
        await house.eventually(lambda: house.jobs.admission.patches == 0)
        assert (await house.get(first["id"]))["state"] == "cancelled"
        assert house.names("results") == [second["id"]]

    play(scenario, jobs_running=1)


def test_cancelling_what_was_begun_anew(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that starts again before the end of its first execution can be cancelled."""
    monkeypatch.setattr("pugeo_service.jobs.completion._ENGINE_RETRY_S", 0.0)
    monkeypatch.setattr("pugeo_service.jobs.runner._PROGRESS_S", 60.0)  # only the event can stop it

    async def scenario(house: Any) -> None:
        runner, complete = house.jobs._runner, Completion.__call__
        ended: list[str] = []

        async def slowly(self: Completion, job: Job, work: Any) -> None:
            if ended:
                await complete(self, job, work)
                return
            house.engine.hold.clear()
            first = runner._stop_events[job.id]
            await complete(self, job, work)
            await house.eventually(lambda: runner._stop_events[job.id] is not first)
            ended.append(job.id)

        monkeypatch.setattr(Completion, "__call__", slowly)
        house.engine.lose = 1
        job = await house.submit()
        await house.eventually(lambda: ended == [job["id"]] and len(runner._tasks) == 1)
        await house.eventually(lambda: house.engine.running == 1)
        assert (await house.http.delete(f"/jobs/{job['id']}")).json()["state"] == "cancelled"
        await house.eventually(lambda: house.engine.running == 0)
        await house.eventually(lambda: runner._stop_events == {} and house.names("inputs") == [])

    play(scenario, jobs_running=2)


def test_deleting_a_result(play: Any) -> None:
    """The file is deleted at once, the state is expired, and the result a 410."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        answer = await house.http.delete(f"/jobs/{job['id']}")
        assert (answer.json()["state"], answer.json()["result"]) == ("expired", None)
        assert house.names("results") == []
        result = await house.http.get(f"/jobs/{job['id']}/result")
        assert (result.status_code, result.json()["code"]) == (410, "result_gone")

    play(scenario)


def test_twice_is_once(play: Any) -> None:
    """DELETE is idempotent in each state; an unknown job is a 404."""

    async def scenario(house: Any) -> None:
        job = await house.submit(b"malformed")
        failed = await house.until(job["id"], "failed")
        for _ in range(2):
            answer = await house.http.delete(f"/jobs/{job['id']}")
            assert (answer.status_code, answer.json()) == (200, failed)
        house.engine.hold.clear()
        job = await house.submit()
        first = (await house.http.delete(f"/jobs/{job['id']}")).json()
        assert (await house.http.delete(f"/jobs/{job['id']}")).json() == first
        missing = await house.http.delete("/jobs/nothing")
        assert (missing.status_code, missing.json()["code"]) == (404, "unknown_job")

    play(scenario)


def test_another_process_cancels(open_house: Any) -> None:
    """A job that runs in one process can be cancelled through another."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as one:
            one.engine.hold.clear()
            job = await one.submit()
            await one.until(job["id"], "running")
            async with open_house(jobs_running=1) as other:
                assert (await other.http.delete(f"/jobs/{job['id']}")).status_code == 200
                await one.eventually(lambda: one.engine.running == 0)
                await one.eventually(lambda: one.names("inputs") == [])
                assert other.engine.began == []

    asyncio.run(whole())
