# SPDX-License-Identifier: Apache-2.0
"""DELETE: cancelling, deleting, and doing so twice."""

import asyncio
from typing import Any

import pytest

from pugeo_service.jobs.completion import Settlement
from pugeo_service.jobs.models import Job


def test_cancelling_what_waits(play: Any) -> None:
    """It never begins, and its input goes at once."""

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
    """Its work ends, its patches leave the queue, its files go, and the next one begins."""

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
    """A job that is begun again before its first attempt has quite ended can still be stopped."""
    monkeypatch.setattr("pugeo_service.jobs.completion._ENGINE_BACK_S", 0.0)
    monkeypatch.setattr("pugeo_service.jobs.runner._TICK_S", 60.0)  # nothing else notices

    async def scenario(house: Any) -> None:
        runner, settle = house.jobs._runner, Settlement.__call__
        ended: list[str] = []

        async def slowly(self: Settlement, job: Job, work: Any) -> None:
            if ended:
                await settle(self, job, work)
                return
            house.engine.hold.clear()
            first = runner._halts[job.id]
            await settle(self, job, work)
            await house.eventually(lambda: runner._halts[job.id] is not first)
            ended.append(job.id)

        monkeypatch.setattr(Settlement, "__call__", slowly)
        house.engine.lose = 1
        job = await house.submit()
        await house.eventually(lambda: ended == [job["id"]] and len(runner._tasks) == 1)
        await house.eventually(lambda: house.engine.running == 1)
        assert (await house.http.delete(f"/jobs/{job['id']}")).json()["state"] == "cancelled"
        await house.eventually(lambda: house.engine.running == 0)
        await house.eventually(lambda: runner._halts == {} and house.names("inputs") == [])

    play(scenario, jobs_running=2)


def test_deleting_a_result(play: Any) -> None:
    """The file is gone at once, the job says so, and its result is a 410."""

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
    """Deleting again changes nothing, whatever the state; an unknown job is a 404."""

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
    """A job that runs in one process is cancelled through another, and stops within a look."""

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
