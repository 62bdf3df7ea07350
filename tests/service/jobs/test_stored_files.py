# SPDX-License-Identifier: Apache-2.0
"""Jobs whose inputs and results are in a store."""

import asyncio
import hashlib
import time
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import fsspec
import pytest
from sqlalchemy import create_engine, text
from tests.service.jobs.conftest import House, Open

from pugeo_service.jobs import runner_beats, stored_files
from pugeo_service.jobs.runner_beats import RunnerBeats
from pugeo_service.storage.object_store import ObjectStore, StoreError

RESULT = b"dense cloudcloud"


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One database for fronts with folders of their own."""
    return f"sqlite:///{tmp_path}/shared.sqlite3"


@pytest.fixture
def settings(store_url: str, tmp_path: Path) -> Any:
    """Settings of a front with a folder of its own, by the name of the front."""
    return lambda name: {"jobs_store": store_url, "jobs_dir": tmp_path / name}


def stored(url: str) -> list[str]:
    """Keys in a store."""
    files, root = fsspec.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
    return sorted(path.removeprefix(root).lstrip("/") for path in files.find(root))


def overwrite(url: str, key: str, data: bytes) -> None:
    """Replace what is stored under a key."""
    files, root = fsspec.url_to_fs(url, skip_instance_cache=True)
    files.makedirs(f"{root}/{key}".rpartition("/")[0], exist_ok=True)
    files.pipe_file(f"{root}/{key}", data)


async def result(house: House, job_id: str, **headers: str) -> Any:
    """The answer to a request for a result."""
    return await house.http.get(f"/jobs/{job_id}/result", headers=headers)


def test_another_front_serves_the_result(open_house: Open, settings: Any, store_url: str) -> None:
    """It has the same bytes, ETag and ranges; after DELETE nothing is left in the store."""

    async def scenario() -> None:
        async with open_house(**settings("one")) as one, open_house(**settings("two")) as two:
            job = await one.submit()
            await one.until(job["id"], "succeeded")
            digest = hashlib.sha256(RESULT).hexdigest()
            await one.eventually(lambda: stored(store_url) == [f"results/{job['id']}/{digest}"])
            near, far = await result(one, job["id"]), await result(two, job["id"])
            assert near.content == far.content == RESULT
            assert near.headers["etag"] == far.headers["etag"] == f'"{digest}"'
            part = await result(two, job["id"], Range="bytes=6-10")
            assert (part.status_code, part.content) == (206, b"cloud")
            await two.http.delete(f"/jobs/{job['id']}")
            assert stored(store_url) == []

    asyncio.run(scenario())


def test_another_front_runs_the_job(open_house: Open, settings: Any) -> None:
    """A job that was queued again is run by a front that has no copy of its input."""

    async def scenario() -> None:
        async with open_house(**settings("one")) as one:
            one.engine.hold.clear()
            job = await one.submit(b"carried over")
            await one.until(job["id"], "running")
        async with open_house(**settings("two")) as two:
            await two.until(job["id"], "succeeded")
            assert two.engine.began == [b"carried over"]

    asyncio.run(scenario())


def test_what_was_altered_is_not_used(open_house: Open, settings: Any, store_url: str) -> None:
    """Neither an input nor a result whose digest is wrong."""

    async def scenario() -> None:
        async with open_house(**settings("one")) as one:
            done = await one.submit()
            await one.until(done["id"], "succeeded")
            one.engine.hold.clear()
            held = await one.submit(b"held")
            await one.until(held["id"], "running")
        for key in stored(store_url):
            overwrite(store_url, key, b"altered bytes")
        async with open_house(**settings("two")) as two:
            answer = await result(two, done["id"])
            assert (answer.status_code, answer.json()["code"]) == (500, "result_lost")
            failed = await two.until(held["id"], "failed")
            assert failed["problem"]["code"] == "input_lost"

    asyncio.run(scenario())


def test_a_store_that_fails(
    open_house: Open, settings: Any, monkeypatch: pytest.MonkeyPatch, store_url: str
) -> None:
    """Requests get 503 with a time to come again, a job is tried again, and nothing is lost."""
    fails = False
    put, get, remove = ObjectStore.put, ObjectStore.get, ObjectStore.remove

    def checked(work: Any) -> Any:
        def run(*arguments: Any) -> None:
            if fails:
                raise StoreError("the bucket is gone")
            work(*arguments)

        return run

    for name, work in (("put", put), ("get", get), ("remove", remove)):
        monkeypatch.setattr(ObjectStore, name, checked(work))
    monkeypatch.setattr("pugeo_service.jobs.completion._REPAIR_S", 0.1)

    async def scenario() -> None:
        nonlocal fails
        async with open_house(**settings("one")) as one, open_house(**settings("two")) as two:
            # It runs no job, so that it has to fetch each result.
            two.engine.workers = 0
            done = await one.submit()
            await one.until(done["id"], "succeeded")
            one.engine.hold.clear()
            held = await one.submit(b"held")
            await one.until(held["id"], "running")
            fails = True
            for answer in (
                await one.http.post("/jobs?R=2", content=b"refused"),
                await result(two, done["id"]),
            ):
                assert (answer.status_code, answer.json()["code"]) == (503, "storage_failed")
                assert answer.headers["retry-after"] == "30"
            one.engine.hold.set()
            while (await one.get(held["id"]))["attempts"] < 2:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            fails = False
            await one.until(held["id"], "succeeded")
            assert (await result(two, held["id"])).content == b"dense heldheld"
            assert (await result(two, done["id"])).content == RESULT
            await one.eventually(
                lambda: not any(key.startswith("inputs/") for key in stored(store_url))
            )

    asyncio.run(scenario())


def test_orphans_are_swept(
    open_house: Open, settings: Any, monkeypatch: pytest.MonkeyPatch, store_url: str
) -> None:
    """Files that no job needs are removed once they are old, and not before; others stay."""

    async def scenario() -> None:
        async with open_house(**settings("one")) as one:
            job = await one.submit()
            await one.until(job["id"], "succeeded")
            await one.eventually(lambda: len(stored(store_url)) == 1)
            kept = stored(store_url)
        for key in ("inputs/orphan", "results/orphan/digest"):
            overwrite(store_url, key, b"x")
        async with open_house(**settings("one")):
            assert len(stored(store_url)) == len(kept) + 2
        monkeypatch.setattr(stored_files, "_YOUNG_S", -3600.0)
        async with open_house(**settings("one")) as one:
            assert stored(store_url) == kept
            assert one.names("results") == []
            assert (await result(one, job["id"])).content == RESULT

    asyncio.run(scenario())


def test_a_copy_here_is_mended(open_house: Open, settings: Any) -> None:
    """A damaged copy of a result is fetched again."""

    async def scenario() -> None:
        async with open_house(**settings("one")) as one:
            job = await one.submit()
            await one.until(job["id"], "succeeded")
            (one.folder / "results" / job["id"]).write_bytes(b"damaged")
            assert (await result(one, job["id"])).content == RESULT

    asyncio.run(scenario())


@pytest.mark.postgres
def test_only_the_dead_are_taken_over(
    open_house: Open, settings: Any, postgres: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a common folder the database tells: a job of a living front stays with it."""
    url = postgres()
    monkeypatch.setattr(runner_beats, "_BEAT_S", 0.05)
    monkeypatch.setattr(runner_beats, "_DEAD_S", 1.0)
    looks: dict[Any, list[float]] = defaultdict(lambda: [0.0])
    look = RunnerBeats.ended

    async def seen(beats: RunnerBeats, names: Collection[str]) -> list[str]:
        found = await look(beats, names)
        looks[beats].append(time.monotonic())
        return found

    monkeypatch.setattr(RunnerBeats, "ended", seen)

    async def scenario() -> None:
        one_settings = {**settings("one"), "database_url": url}
        two_settings = {**settings("two"), "database_url": url}
        async with open_house(**one_settings) as one, open_house(**two_settings) as two:
            for house in (one, two):
                house.engine.hold.clear()
            job = await one.submit(b"long")
            await one.until(job["id"], "running")
            runner = one if one.engine.running else two
            other = two if runner is one else one
            # The other looks for longer than three times the silence of a dead one.
            mine = looks[other.jobs._beats]
            begin = time.monotonic()
            await other.eventually(lambda: mine[-1] > begin + 3.0 * runner_beats._DEAD_S)
            assert (await one.get(job["id"]))["attempts"] == 1
            engine = create_engine(url.replace("postgresql://", "postgresql+pg8000://"))
            with engine.begin() as connection:
                connection.execute(text("update pugeo_jobs set runner = 'ended'"))
            engine.dispose()
            other.engine.hold.set()
            runner.engine.hold.set()
            told = await one.until(job["id"], "succeeded")
            assert told["attempts"] == 2

    asyncio.run(scenario())
