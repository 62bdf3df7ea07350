# SPDX-License-Identifier: Apache-2.0
"""GET /jobs/{id}/events: events, their order, and the end of the stream."""

import asyncio
import dataclasses
import json
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.jobs.change_feed import ChangeFeed
from pugeo_service.jobs.events import stream
from pugeo_service.jobs.models import Job
from pugeo_service.keys import Entry, hash_of
from pugeo_service.problems import ProblemError

JOB = Job(
    id="1", owner="", state="queued", revision=1, idempotency_key=None, request_digest="",
    request_id="", options={}, format=None, answer="ply", input_bytes=1, input_sha256="",
    created_at=0.0,
)  # fmt: skip


def feed_of(fetch: Callable[[list[str]], Awaitable[list[Job]]]) -> ChangeFeed:
    """A feed of the jobs that ``fetch`` returns at each query."""
    latest: list[Job] = []

    async def revisions(ids: list[str]) -> dict[str, int]:
        latest[:] = await fetch(ids)
        return {job.id: job.revision for job in latest}

    async def found(ids: list[str]) -> list[Job]:
        return [job for job in latest if job.id in ids]

    return ChangeFeed(revisions, found)


def events(text: str) -> list[tuple[str, int, Any]]:
    """Name, id and data of each event, without comments."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if line[:1] != ":")
        if "event" in fields:
            found.append((fields["event"], int(fields["id"]), json.loads(fields["data"])))
    return found


def test_a_whole_life(play: Any) -> None:
    """State, progress, and one end, with growing ids; then the stream ends."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.eventually(lambda: bool(house.jobs.changes._subscribers))
        with house.jobs.changes.subscribe(job["id"]) as changes:
            # Each change reaches all subscribers at the same time.
            while (await changes.get()).patches_total is None:
                pass
        house.engine.hold.set()
        answer = await call
        assert answer.headers["content-type"].startswith("text/event-stream")
        told = events(answer.text)
        names = [name for name, _, _ in told]
        assert names[0] == "state"
        assert names[-2:] == ["state", "end"]
        # Progress made before the stream was opened is part of the first state.
        progress = [data.get("progress", data) for _, _, data in told]
        assert {"stage": "predict", "done": 1, "total": 4} in progress
        ids = [number for _, number, _ in told]
        assert ids == sorted(ids)
        assert len(set(ids[:-1])) == len(ids) - 1
        assert told[-1][2]["state"] == "succeeded"
        assert not house.jobs.changes._subscribers

    play(scenario)


def test_a_client_that_comes_back(play: Any) -> None:
    """Last-Event-ID skips known events; an id that is not of this job is ignored."""

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
    """Changes made by another process are sent too."""

    async def whole() -> None:
        async with open_house(jobs_running=1) as one:
            one.engine.hold.clear()
            job = await one.submit()
            await one.until(job["id"], "running")
            async with open_house() as other:
                call = asyncio.create_task(other.http.get(f"/jobs/{job['id']}/events"))
                await other.eventually(lambda: bool(other.jobs.changes._subscribers))
                one.engine.hold.set()
                told = events((await call).text)
                assert [name for name, _, _ in told][-2:] == ["state", "end"]

    asyncio.run(whole())


def test_a_drain_ends_streams(play: Any) -> None:
    """Streams are closed without an end event; new ones are refused."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.eventually(lambda: bool(house.jobs.changes._subscribers))
        house.jobs.drain()
        async with asyncio.timeout(60):
            answer = await call
        assert "end" not in [name for name, _, _ in events(answer.text)]
        assert "retry: 2000" in answer.text
        refused = await house.http.get(f"/jobs/{job['id']}/events")
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")

    play(scenario)


def test_the_end_of_watching_stands() -> None:
    """A query that ends after the close of the feed does not replace the end."""

    async def scenario() -> Job | None:
        asked, answered = asyncio.Event(), asyncio.Event()

        async def fetch(_: list[str]) -> list[Job]:
            asked.set()
            await answered.wait()
            return [JOB]

        feed = feed_of(fetch)
        running = asyncio.create_task(feed.run())
        with feed.subscribe(JOB.id) as changes:
            await asked.wait()
            feed.close()
            asked.clear()
            answered.set()
            feed.notify()
            await asked.wait()  # the first query is processed, since the second one has begun
            latest = changes.get_nowait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return latest

    assert asyncio.run(scenario()) is None


def test_cancelling_ends_the_stream(play: Any) -> None:
    """The last event of a cancelled job has the state cancelled."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        call = asyncio.create_task(house.http.get(f"/jobs/{job['id']}/events"))
        await house.eventually(lambda: bool(house.jobs.changes._subscribers))
        await house.http.delete(f"/jobs/{job['id']}")
        name, _, data = events((await call).text)[-1]
        assert (name, data["state"]) == ("end", "cancelled")

    play(scenario)


def test_silence_is_filled() -> None:
    """Comments are sent during silence; each change is sent once."""

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
    """A subscription beyond the bound is refused; an ended one makes room."""
    monkeypatch.setattr("pugeo_service.jobs.change_feed._MAX_SUBSCRIBERS", 2)

    async def nothing(_: list[str]) -> list[Job]:
        return []

    async def scenario() -> None:
        feed = feed_of(nothing)
        with feed.subscribe("a"):
            with feed.subscribe("a"), pytest.raises(ProblemError), feed.subscribe("b"):
                pass
            with feed.subscribe("b"):
                pass

    asyncio.run(scenario())


def test_streams_are_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """One key reaches half of the streams, two a third each, and none is left out."""
    monkeypatch.setattr("pugeo_service.jobs.change_feed._MAX_SUBSCRIBERS", 12)

    async def nothing(_: list[str]) -> list[Job]:
        return []

    async def scenario() -> Counter[str]:
        feed, held = feed_of(nothing), Counter[str]()
        with ExitStack() as open_streams:
            for owner in [*("a" * 12), *("b" * 12), *("c" * 12)]:
                try:
                    open_streams.enter_context(feed.subscribe("job", owner=owner))
                except ProblemError as problem:
                    assert (problem.status, problem.code) == (429, "share_exceeded")  # noqa: PT017
                else:
                    held[owner] += 1
        assert feed._by_owner.total() == 0
        return held

    assert asyncio.run(scenario()) == {"a": 6, "b": 3, "c": 2}


def test_the_work_grows_with_the_number_of_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 streams, opened one after the other, ask for their jobs some times and not 300 times."""
    monkeypatch.setattr("pugeo_service.jobs.change_feed._POLL_S", 0.02)
    count, asked = 300, 0

    async def fetch(ids: list[str]) -> list[Job]:
        nonlocal asked
        asked += len(ids)
        return [dataclasses.replace(JOB, id=each) for each in ids]

    async def scenario() -> None:
        feed = feed_of(fetch)
        running = asyncio.create_task(feed.run())
        with ExitStack() as open_streams:
            queues = []
            for number in range(count):
                queues.append(open_streams.enter_context(feed.subscribe(str(number))))
                for _ in range(9):  # as long as a request takes to be served
                    await asyncio.sleep(0)
            for queue in queues:
                assert (await queue.get()) is not None
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(scenario())
    assert asked < 10 * count


def test_a_revoked_key_hears_no_more(play: Any, tmp_path: Path) -> None:
    """A stream ends once its key is removed; that of another key goes on."""
    file = tmp_path / "keys"
    entries = {name: str(Entry(name, hash_of(name))) for name in ("ann", "bob")}
    file.write_text("\n".join(entries.values()))

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        calls = {}
        for name in entries:
            headers = {"X-API-Key": name}
            job = (await house.http.post("/jobs", content=b"x", headers=headers)).json()
            path = f"/jobs/{job['id']}/events"
            calls[name] = asyncio.create_task(house.http.get(path, headers=headers))
        await house.eventually(lambda: len(house.jobs.changes._subscribers) == 2)
        file.write_text(entries["bob"])
        async with asyncio.timeout(60):
            told = events((await calls["ann"]).text)
        assert "end" not in [name for name, _, _ in told]
        assert not calls["bob"].done()
        house.engine.hold.set()
        assert events((await calls["bob"]).text)[-1][0] == "end"

    play(scenario, api_keys_file=file)


def test_a_slow_subscriber_gets_the_latest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A state that was not taken is replaced by a later one; a missing job is the end."""
    monkeypatch.setattr("pugeo_service.jobs.change_feed._POLL_S", 600.0)

    async def scenario() -> list[Job | None]:
        answers = [[dataclasses.replace(JOB, revision=r)] for r in (2, 3, 4)]
        served = iter([*answers, []])

        asked = asyncio.Event()

        async def fetch(_: list[str]) -> list[Job]:
            asked.set()
            return next(served)

        feed = feed_of(fetch)
        running = asyncio.create_task(feed.run())
        with feed.subscribe("1") as changes:
            for _ in range(3):
                asked.clear()
                feed.notify()
                await asked.wait()
            taken = [changes.get_nowait()]
            feed.notify()
            taken.append(await changes.get())
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return taken

    latest, gone = asyncio.run(scenario())
    assert latest is not None
    assert latest.revision == 4
    assert gone is None
