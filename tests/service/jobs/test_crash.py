# SPDX-License-Identifier: Apache-2.0
"""Processes that end, in good order or not, and processes that share a folder."""

import asyncio
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.jobs import runner_queries
from pugeo_service.jobs.process_lock import Presence


def test_a_drain_parks_what_runs(open_house: Any) -> None:
    """The job goes back into the queue, uncounted, and is finished after the restart."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as house:
            house.engine.hold.clear()
            running, waiting = await house.submit(b"one"), await house.submit(b"two")
            await house.until(running["id"], "running")
            house.jobs.drain()
            parked = await house.until(running["id"], "queued")
            assert parked["attempts"] == 0
            refused = await house.http.post("/jobs", content=b"three")
            assert (refused.status_code, refused.json()["code"]) == (503, "draining")
            assert "retry-after" in refused.headers
        assert list((house.folder / "runners").iterdir()) == []
        async with open_house(jobs_running=1) as house:
            for job, body in ((running, b"one"), (waiting, b"two")):
                done = await house.until(job["id"], "succeeded")
                assert done["attempts"] == 1
                result = await house.http.get(f"/jobs/{job['id']}/result")
                assert result.content == b"dense " + body * 2

    asyncio.run(whole())


def test_the_jobs_of_the_dead_are_taken_over(open_house: Any) -> None:
    """Another process finishes them; one that was only thought dead stops and spoils nothing."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as one:
            one.engine.hold.clear()
            job = await one.submit()
            # The table says "running" a moment before the runner has heard of it: a drain in that
            # moment gives the job back uncounted.
            await one.eventually(lambda: one.engine.running == 1)
            one.jobs._runner._draining = True  # it begins nothing more
            one.jobs._presence.leave()  # what the kernel does at a kill -9
            async with open_house(jobs_running=1) as other:
                done = await other.until(job["id"], "succeeded")
                assert done["attempts"] == 2
                await one.eventually(lambda: one.engine.running == 0)
                one.engine.hold.set()
                result = await other.http.get(f"/jobs/{job['id']}/result")
                assert result.content == b"dense cloudcloud"
                assert other.names("results") == [job["id"]]

    asyncio.run(whole())


def test_a_job_that_ends_the_service(open_house: Any) -> None:
    """It is begun so often and no more, then fails and says why; others are done."""

    async def whole() -> None:
        ids: dict[bytes, str] = {}
        for attempt in range(3):
            async with open_house(jobs_running=1, jobs_attempts=3) as house:
                house.engine.hold.clear()
                if not ids:
                    ids = {name: (await house.submit(name))["id"] for name in (b"bad", b"good")}
                await house.until(ids[b"bad"], "running")
                assert (await house.get(ids[b"bad"]))["attempts"] == attempt + 1
                # The end comes without a word to the database.
                house.jobs._presence.leave()
                house.jobs._runner._settle = forget
        async with open_house(jobs_running=1, jobs_attempts=3) as house:
            failed = await house.until(ids[b"bad"], "failed")
            problem = failed["problem"]
            assert (problem["status"], problem["code"]) == (422, "job_crashed")
            assert (problem["attempts"], problem["retryable"]) == (3, False)
            await house.until(ids[b"good"], "succeeded")
            assert house.engine.began == [b"good"]
            await house.eventually(lambda: house.names("inputs") == [])

    class Forget:
        hurry = True

        async def __call__(self, *_: Any) -> None:
            pass

    forget = Forget()
    asyncio.run(whole())


def test_two_processes_share(open_house: Any) -> None:
    """Each job is run by one of them, once, and each tells of all."""

    async def whole() -> None:
        async with open_house() as one, open_house() as other:
            bodies = [b"cloud %d" % number for number in range(12)]
            houses = [one, other] * 6
            jobs = [await house.submit(body) for house, body in zip(houses, bodies, strict=True)]
            for job in jobs:
                await other.until(job["id"], "succeeded")
                result = await one.http.get(f"/jobs/{job['id']}/result")
                assert result.status_code == 200
            began = Counter(one.engine.began) + Counter(other.engine.began)
            assert began == Counter(bodies)
            assert one.engine.began
            assert other.engine.began

    asyncio.run(whole())


def test_orphans_are_swept(open_house: Any) -> None:
    """At the start files without a job go, and those of jobs stay."""

    async def whole() -> None:
        async with open_house() as house:
            done = await house.submit()
            await house.until(done["id"], "succeeded")
            house.engine.hold.clear()
            waiting = await house.submit()
            await house.until(waiting["id"], "running")
        for name in ("inputs/orphan", "results/orphan", "parts/dead.orphan.in"):
            (house.folder / name).write_bytes(b"half")
        async with open_house() as house:
            await house.until(waiting["id"], "succeeded")
            await house.eventually(lambda: house.names("inputs") == [])
            assert house.names("parts") == []
            assert house.names("results") == sorted([done["id"], waiting["id"]])

    asyncio.run(whole())


def test_the_files_of_the_living_are_not_swept(open_house: Any) -> None:
    """What another process has on its way, its row not written yet, stays."""

    async def whole() -> None:
        async with open_house() as one:
            part = one.jobs.files.new_input("underway")
            await part.write(b"half")
            await part.flush()
            (one.folder / "inputs" / "fresh").write_bytes(b"whole")
            async with open_house() as other:
                assert other.names("inputs") == ["fresh"]
                assert len(other.names("parts")) == 1
            part.close()

    asyncio.run(whole())


def test_what_comes_while_the_sweep_looks(open_house: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that appears after the table was read stays, also where nobody else was there."""

    async def whole() -> None:
        async with open_house() as house:
            late = house.folder / "inputs" / "late"
        wanted = runner_queries.wanted

        def meanwhile(connection: Any) -> Any:
            found = wanted(connection)
            time.sleep(0.05)
            late.write_bytes(b"whole")
            return found

        monkeypatch.setattr(runner_queries, "wanted", meanwhile)
        async with open_house() as house:
            assert house.names("inputs") == ["late"]

    asyncio.run(whole())


@pytest.mark.parametrize("harm", ["gone", "changed"])
def test_an_input_that_was_lost(open_house: Any, harm: str) -> None:
    """A file that is gone or changed fails its job, and no result is made of it."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as house:
            house.engine.hold.clear()
            job = await house.submit()
            await house.until(job["id"], "running")
        path = house.folder / "inputs" / job["id"]
        path.write_bytes(b"other") if harm == "changed" else path.unlink()
        async with open_house() as house:
            failed = await house.until(job["id"], "failed")
            assert (failed["problem"]["code"], failed["problem"]["retryable"]) == (
                "input_lost",
                True,
            )
            assert house.names("results") == []

    asyncio.run(whole())


def test_a_claim_whose_answer_was_lost(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that is marked as run here and is not goes back into the queue."""
    monkeypatch.setattr("pugeo_service.jobs.runner._STRAY_S", 0.2)

    async def scenario(house: Any) -> None:
        runner = house.jobs._runner
        runner._limit, limit = 0, runner._limit
        job = await house.submit()
        await house.jobs._database.write(
            runner_queries.claim, house.jobs._presence.name, time.time()
        )
        runner._limit = limit
        done = await house.until(job["id"], "succeeded")
        assert done["attempts"] == 2

    play(scenario)


def test_a_killed_process_is_dead(tmp_path: Path) -> None:
    """Its lock goes with it, at once; while it lives, even stopped, it counts as alive."""
    code = (
        "import sys, time; from pathlib import Path; from pugeo_service.jobs.process_lock import "
        "Presence; p = Presence(Path(sys.argv[1])); p.enter(); print(p.name, flush=True); "
        "time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        name = other.stdout.readline().strip()
        presence = Presence(tmp_path)
        presence.enter()
        assert presence.alive(name)
        assert not presence.alone
        other.send_signal(signal.SIGSTOP)
        assert presence.dead([name, presence.name, "never"]) == ["never"]
        other.kill()
        other.wait()
        assert presence.dead([name]) == [name]
        assert presence.alone
        presence.leave()
    assert list((tmp_path / "runners").iterdir()) == []
