# SPDX-License-Identifier: Apache-2.0
"""Shutdowns and crashes of processes, and processes that share a folder."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.jobs import repository
from pugeo_service.jobs.process_lock import ProcessLock


def test_a_drain_queues_running_jobs_again(open_house: Any) -> None:
    """A running job is queued again without counting the attempt, and ends after the restart."""

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


def test_jobs_of_ended_processes_are_taken_over(open_house: Any) -> None:
    """Another process finishes them; the first one, if it still runs, stops without an effect."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as one:
            one.engine.hold.clear()
            job = await one.submit()
            # The table says "running" just before the runner starts the job.
            await one.eventually(lambda: one.engine.running == 1)
            one.jobs._runner._draining = True  # it starts no further job
            one.jobs._lock.release()  # as the kernel does at a SIGKILL
            async with open_house(jobs_running=1) as other:
                done = await other.until(job["id"], "succeeded")
                assert done["attempts"] == 2
                await one.eventually(lambda: one.engine.running == 0)
                one.engine.hold.set()
                result = await other.http.get(f"/jobs/{job['id']}/result")
                assert result.content == b"dense cloudcloud"
                assert other.names("results") == [job["id"]]

    asyncio.run(whole())


def test_a_job_that_crashes_the_service(open_house: Any) -> None:
    """After the maximum number of attempts the job fails; other jobs are finished."""

    async def whole() -> None:
        ids: dict[bytes, str] = {}
        for attempt in range(3):
            async with open_house(jobs_running=1, jobs_attempts=3) as house:
                house.engine.hold.clear()
                if not ids:
                    ids = {name: (await house.submit(name))["id"] for name in (b"bad", b"good")}
                await house.until(ids[b"bad"], "running")
                assert (await house.get(ids[b"bad"]))["attempts"] == attempt + 1
                # The process ends without an update of the database.
                house.jobs._lock.release()
                house.jobs._runner._completion = forget
        async with open_house(jobs_running=1, jobs_attempts=3) as house:
            failed = await house.until(ids[b"bad"], "failed")
            problem = failed["problem"]
            assert (problem["status"], problem["code"]) == (422, "job_crashed")
            assert (problem["attempts"], problem["retryable"]) == (3, False)
            await house.until(ids[b"good"], "succeeded")
            assert house.engine.began == [b"good"]
            await house.eventually(lambda: house.names("inputs") == [])

    class Forget:
        shutting_down = True

        async def __call__(self, *_: Any) -> None:
            pass

    forget = Forget()
    asyncio.run(whole())


def test_two_processes_share(open_house: Any) -> None:
    """Each job runs once in one of two processes, and both serve all jobs."""

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
    """At the start files without a job are removed, and files of jobs are kept."""

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


def test_files_of_running_processes_are_kept(open_house: Any) -> None:
    """Files of another process whose row is not inserted yet are kept."""

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


def test_files_made_during_the_sweep_are_kept(
    open_house: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that appears after the query of the table is kept."""

    async def whole() -> None:
        async with open_house() as house:
            late = house.folder / "inputs" / "late"
        wanted = repository.wanted_files

        def meanwhile(connection: Any) -> Any:
            found = wanted(connection)
            late.write_bytes(b"whole")
            # The time of a file may have a coarser clock than `time.time`.
            os.utime(late, (time.time() + 1, time.time() + 1))
            return found

        monkeypatch.setattr(repository, "wanted_files", meanwhile)
        async with open_house() as house:
            assert house.names("inputs") == ["late"]

    asyncio.run(whole())


@pytest.mark.parametrize("harm", ["gone", "changed"])
def test_an_input_that_was_lost(open_house: Any, harm: str) -> None:
    """A job whose input is missing or changed fails and has no result."""

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
    """A job that is assigned to this process but does not run is queued again."""
    monkeypatch.setattr("pugeo_service.jobs.runner._UNKNOWN_S", 0.2)

    async def scenario(house: Any) -> None:
        runner = house.jobs._runner
        runner._limit, limit = 0, runner._limit
        job = await house.submit()
        await house.jobs._database.write(repository.claim, house.jobs._lock.name, time.time())
        runner._limit = limit
        done = await house.until(job["id"], "succeeded")
        assert done["attempts"] == 2

    play(scenario)


def test_a_killed_process_has_ended(tmp_path: Path) -> None:
    """Its lock is released at once; a stopped process still counts as running."""
    code = (
        "import signal, sys; from pathlib import Path; from pugeo_service.jobs.process_lock import "
        "ProcessLock; p = ProcessLock(Path(sys.argv[1])); p.acquire(); print(p.name, flush=True); "
        "signal.pause()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        name = other.stdout.readline().strip()
        lock = ProcessLock(tmp_path)
        lock.acquire()
        assert lock.is_alive(name)
        assert not lock.is_only_process
        other.send_signal(signal.SIGSTOP)
        assert lock.ended([name, lock.name, "never"]) == ["never"]
        other.kill()
        other.wait()
        assert lock.ended([name]) == [name]
        assert lock.is_only_process
        lock.release()
    assert list((tmp_path / "runners").iterdir()) == []
