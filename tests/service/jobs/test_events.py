# SPDX-License-Identifier: Apache-2.0
"""GET /jobs/{id}/events: what is told, in which order, and when it ends."""

import asyncio
import dataclasses
import json
from typing import Any

import pytest

from pugeo_service.jobs.change_feed import Watch
from pugeo_service.jobs.events import stream
from pugeo_service.jobs.models import Job

JOB = Job(
    id="1", owner="", state="queued", revision=1, idempotency_key=None, request_digest="",
    request_id="", options={}, format=None, answer="ply", input_bytes=1, input_sha256="",
    created_at=0.0,
)  # fmt: skip


def events(text: str) -> list[tuple[str, int, Any]]:
    """Name, id and data of each event; comments and the rest left out."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if line[:1] != ":")
        if "event" in fields:
            found.append((fields["event"], int(fields["id"]), json.loads(fields["data"])))
    return found


def test_a_whole_life(play: Any) -> None:
    """State, progress, and one end, with ids that grow; then the stream is over."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.until(job["id"], "running")
        await asyncio.sleep(0.3)
        house.engine.hold.set()
        answer = await call
        assert answer.headers["content-type"].startswith("text/event-stream")
        told = events(answer.text)
        names = [name for name, _, _ in told]
        assert names[0] == "state"
        assert names[-2:] == ["state", "end"]
        # One that comes while the stream is opened is told with the state.
        progress = [data.get("progress", data) for _, _, data in told]
        assert {"stage": "predict", "done": 1, "total": 4} in progress
        ids = [number for _, number, _ in told]
        assert ids == sorted(ids)
        assert len(set(ids[:-1])) == len(ids) - 1
        assert told[-1][2]["state"] == "succeeded"
        assert not house.jobs.watch._watchers

    play(scenario)


def test_a_client_that_comes_back(play: Any) -> None:
    """Last-Event-ID spares it what it has; one that is no id of this job is as none."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        path = f"/jobs/{job['id']}/events"
        told = events((await house.http.get(path)).text)
        assert [name for name, _, _ in told] == ["state", "end"]
        for seen in (str(told[-1][1]), "1", "999", "-1", "what", "9" * 50):
            answer = await house.http.get(path, headers={"Last-Event-ID": seen})
            names = [name for name, _, _ in events(answer.text)]
            assert names == (["end"] if seen == str(told[-1][1]) else ["state", "end"]), seen

    play(scenario)


def test_a_job_of_another_process(open_house: Any) -> None:
    """Changes made elsewhere are told too."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as one:
            one.engine.hold.clear()
            job = await one.submit()
            await one.until(job["id"], "running")
            async with open_house() as other:
                call = asyncio.create_task(other.http.get(f"/jobs/{job['id']}/events"))
                await asyncio.sleep(0.2)
                one.engine.hold.set()
                told = events((await call).text)
                assert [name for name, _, _ in told][-2:] == ["state", "end"]

    asyncio.run(whole())


def test_a_drain_ends_streams(play: Any) -> None:
    """Streams are closed without an end, so that clients come back; new ones are refused."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.eventually(lambda: bool(house.jobs.watch._watchers))
        house.jobs.drain()
        async with asyncio.timeout(2):
            answer = await call
        assert "end" not in [name for name, _, _ in events(answer.text)]
        assert "retry: 2000" in answer.text
        refused = await house.http.get(f"/jobs/{job['id']}/events")
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")

    play(scenario)


def test_the_end_of_watching_stands() -> None:
    """An answer of the database that comes after the end does not replace it."""

    async def scenario() -> Job | None:
        asked, answered = asyncio.Event(), asyncio.Event()

        async def fetch(_: list[str]) -> list[Job]:
            asked.set()
            await answered.wait()
            return [JOB]

        watch = Watch(fetch)
        looking = asyncio.create_task(watch.run())
        with watch.following(JOB.id) as changes:
            await asked.wait()
            watch.close()
            answered.set()
            await asyncio.sleep(0.05)
            latest = changes.get_nowait()
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        return latest

    assert asyncio.run(scenario()) is None


def test_cancelling_ends_the_stream(play: Any) -> None:
    """The last event tells that the job was cancelled."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.eventually(lambda: bool(house.jobs.watch._watchers))
        await house.http.delete(f"/jobs/{job['id']}")
        name, _, data = events((await call).text)[-1]
        assert (name, data["state"]) == ("end", "cancelled")

    play(scenario)


def test_silence_is_filled() -> None:
    """While nothing happens a comment is sent from time to time; changes are told once."""

    async def told() -> list[bytes]:
        changes: asyncio.Queue[Job | None] = asyncio.Queue()
        source = stream(JOB, changes, None, heartbeat_s=0.01)
        found = [await anext(source) for _ in range(4)]
        running = dataclasses.replace(JOB, state="running", revision=2)
        for latest in (JOB, running, running, None):
            changes.put_nowait(latest)
        return found + [event async for event in source if not event.startswith(b":")]

    first, state, *comments, change = asyncio.run(told())
    assert b"retry" in first
    assert b"event: state" in state
    assert [comment[:1] for comment in comments] == [b":", b":"]
    assert b'"running"' in change
    assert b"id: 2" in change


def test_watchers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """One more than the bound is refused; those that left make room."""
    from pugeo_service.problems import ProblemError

    monkeypatch.setattr("pugeo_service.jobs.change_feed._MOST_WATCHERS", 2)

    async def nothing(_: list[str]) -> list[Job]:
        return []

    async def scenario() -> None:
        watch = Watch(nothing)
        with watch.following("a"):
            with watch.following("a"), pytest.raises(ProblemError):
                watch.check()
            watch.check()

    asyncio.run(scenario())


def test_a_slow_watcher_gets_the_latest() -> None:
    """What it did not take is replaced, so that it costs no memory; a job that is gone ends it."""

    async def scenario() -> list[Job | None]:
        answers = [[dataclasses.replace(JOB, revision=r)] for r in (2, 3, 4)]
        served = iter([*answers, []])

        async def fetch(_: list[str]) -> list[Job]:
            return next(served)

        watch = Watch(fetch)
        looking = asyncio.create_task(watch.run())
        with watch.following("1") as changes:
            for _ in range(3):
                watch.changed()
                await asyncio.sleep(0.01)
            taken = [changes.get_nowait()]
            watch.changed()
            taken.append(await changes.get())
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        return taken

    latest, gone = asyncio.run(scenario())
    assert latest is not None
    assert latest.revision == 4
    assert gone is None
