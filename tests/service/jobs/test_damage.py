# SPDX-License-Identifier: Apache-2.0
"""Full disks, damaged rows and results, and a database that is removed."""

import asyncio
import contextlib
import os
import sqlite3
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection

from pugeo_service.jobs.database import Database
from pugeo_service.storage.reserve import Reserve


@pytest.fixture
def only_sqlite(database_url: str | None) -> None:
    """Skip the test with another database."""
    if database_url is not None:
        pytest.skip("this is about the file of SQLite")


@pytest.fixture
def disk() -> Iterator[Path]:
    """A file system of 2 MiB."""
    folder = Path(tempfile.mkdtemp(prefix="pugeo-full-disk-"))
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "pugeo-test", str(folder)]
    if os.geteuid() or subprocess.run(command, check=False, capture_output=True).returncode:
        folder.rmdir()
        pytest.skip("making a small file system takes more rights than this has")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        folder.rmdir()


def fill(folder: Path) -> None:
    """Fill a disk to its last byte."""
    with contextlib.suppress(OSError), (folder / "filler").open("ab", buffering=0) as file:
        for size in (4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))


@pytest.mark.usefixtures("only_sqlite")
def test_deleting_works_on_a_full_disk(play: Any, disk: Path) -> None:
    """A result can be deleted and an active job cancelled, which gives the room back."""

    async def scenario(house: Any) -> None:
        kept = await house.submit(b"x" * 100_000)
        await house.until(kept["id"], "succeeded")
        await house.eventually((house.folder / "reserve").exists)
        house.engine.hold.clear()
        running = await house.submit(b"y")
        await house.until(running["id"], "running")
        with sqlite3.connect(house.folder / "jobs.sqlite3") as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        fill(disk)
        assert (await house.http.post("/jobs", content=b"z")).status_code == 503
        for job in (running, kept):
            answer = await house.http.delete(f"/jobs/{job['id']}")
            assert answer.status_code == 200, answer.text
        assert house.names("results") == []
        house.engine.hold.set()
        await house.until((await house.submit(b"z"))["id"], "succeeded")

    play(scenario, jobs_dir=disk / "jobs")


@pytest.mark.usefixtures("only_sqlite")
def test_expiring_works_on_a_full_disk(play: Any, disk: Path) -> None:
    """Results expire on a full disk as well."""

    async def scenario(house: Any) -> None:
        job = await house.submit(b"x" * 100_000)
        await house.until(job["id"], "succeeded")
        await house.eventually((house.folder / "reserve").exists)
        with sqlite3.connect(house.folder / "jobs.sqlite3") as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        fill(disk)
        await house.until(job["id"], "expired")
        await house.eventually(lambda: house.names("results") == [])

    play(scenario, jobs_dir=disk / "jobs", jobs_ttl_s=2.0)


def test_a_reserve_is_made_and_given_up(tmp_path: Path) -> None:
    """The file is made once, given up once, and not made where it cannot be."""
    reserve = Reserve(tmp_path / "reserve")
    assert not reserve.release()
    reserve.fill()
    made = (tmp_path / "reserve").stat()
    assert made.st_blocks * 512 >= 256 << 10
    reserve.fill()
    assert (tmp_path / "reserve").stat().st_ino == made.st_ino
    assert reserve.release()
    assert list(tmp_path.iterdir()) == []
    Reserve(tmp_path / "missing" / "reserve").fill()


DAMAGE = {
    "options": "{not json",
    "report": b"\xff\xfe",
    "state": "dancing",
    "answer": "holograms",
    "created_at": 1e300,
    "revision": "many",
    "attempts": "some",
    "format": b"\xff",
}


def damage(connection: sqlite3.Connection, job_id: str, column: str) -> None:
    """Put a value into a row that no job has."""
    value = DAMAGE[column]
    # Bytes as a text that is not UTF-8, as a broken disk leaves it.
    marker = "CAST(? AS TEXT)" if isinstance(value, bytes) else "?"
    statement = f"UPDATE pugeo_jobs SET {column} = {marker} WHERE id = ?"  # noqa: S608
    connection.execute(statement, (value, job_id))


@pytest.mark.usefixtures("only_sqlite")
@pytest.mark.parametrize("column", ["options", "answer", "created_at", "revision", "attempts"])
def test_a_damaged_row_stops_no_other_job(play: Any, column: str) -> None:
    """A queued job whose row is damaged fails; those behind it run."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        first = await house.submit()
        await house.until(first["id"], "running")
        broken, other = await house.submit(b"broken"), await house.submit(b"other")
        with sqlite3.connect(house.folder / "jobs.sqlite3") as connection:
            damage(connection, broken["id"], column)
        house.engine.hold.set()
        await house.until(other["id"], "succeeded")
        listed = (await house.http.get("/jobs")).json()["jobs"]
        assert {job["id"] for job in listed} >= {first["id"], other["id"]}
        assert b"broken" not in house.engine.began

    play(scenario, jobs_running=1)


@pytest.mark.usefixtures("only_sqlite")
@pytest.mark.parametrize("column", list(DAMAGE))
def test_a_damaged_row_is_told(play: Any, column: str) -> None:
    """It is left out of lists, which go on behind it; asking for it is a 500 that says why."""

    async def scenario(house: Any) -> None:
        jobs = [await house.submit() for _ in range(3)]
        for job in jobs:
            await house.until(job["id"], "succeeded")
        broken = jobs[1]["id"]
        with sqlite3.connect(house.folder / "jobs.sqlite3") as connection:
            damage(connection, broken, column)
        found, cursor = [], ""
        while True:
            page = (await house.http.get(f"/jobs?limit=1{cursor}")).json()
            found += [job["id"] for job in page["jobs"]]
            if page["next"] is None:
                break
            cursor = f"&cursor={page['next']}"
        expected = [job["id"] for job in reversed(jobs)]
        if column == "format":  # any text is one
            assert found == expected
            return
        assert found == [each for each in expected if each != broken]
        answer = await house.http.get(f"/jobs/{broken}")
        assert (answer.status_code, answer.json()["code"]) == (500, "job_unreadable")

    play(scenario)


@pytest.mark.parametrize("damage", ["truncated", "altered", "longer"])
def test_a_damaged_result_is_not_served(play: Any, damage: str) -> None:
    """A result whose bytes have changed is a 500 and not a 200 with the old ETag."""

    async def scenario(house: Any) -> None:
        job = await house.submit()
        await house.until(job["id"], "succeeded")
        path = f"/jobs/{job['id']}/result"
        good = await house.http.get(path)
        assert good.status_code == 200
        file = house.folder / "results" / job["id"]
        changed = {
            "truncated": good.content[:-1],
            "altered": b"X" + good.content[1:],
            "longer": good.content + b"X",
        }[damage]
        file.write_bytes(changed)
        for headers in ({}, {"Range": "bytes=0-3"}):
            answer = await house.http.get(path, headers=headers)
            assert (answer.status_code, answer.json()["code"]) == (500, "result_lost")
        same = await house.http.get(path, headers={"If-None-Match": good.headers["etag"]})
        assert same.status_code == 304
        file.write_bytes(good.content)
        assert (await house.http.get(path)).content == good.content

    play(scenario)


@pytest.mark.usefixtures("only_sqlite")
def test_a_removed_database_file_is_written_again(open_house: Any) -> None:
    """What was accepted before and after the removal is there after a restart."""

    async def whole() -> list[str]:
        async with open_house() as house:
            house.engine.hold.clear()
            ids = [(await house.submit())["id"]]
            (house.folder / "jobs.sqlite3").unlink()
            ids.append((await house.submit())["id"])
            assert (house.folder / "jobs.sqlite3").exists()
        async with open_house() as house:
            for job_id in ids:
                await house.until(job_id, "succeeded")
            listed = (await house.http.get("/jobs")).json()["jobs"]
            assert [job["id"] for job in listed] == ids[::-1]
        return ids

    asyncio.run(whole())


def test_a_file_that_is_removed_amid_a_transaction(tmp_path: Path) -> None:
    """The transaction that runs is part of the new file, and so is one that comes meanwhile."""
    path = tmp_path / "jobs.sqlite3"
    begun, gate = threading.Event(), threading.Event()

    def add(connection: Connection, number: int) -> None:
        if number == 2:
            begun.set()
            assert gate.wait(60)
        connection.exec_driver_sql("CREATE TABLE IF NOT EXISTS added (number INTEGER)")
        connection.exec_driver_sql("INSERT INTO added VALUES (?)", (number,))

    def added(connection: Connection) -> list[int]:
        rows = connection.exec_driver_sql("SELECT number FROM added ORDER BY number")
        return [number for (number,) in rows]

    async def run() -> None:
        database = Database(f"sqlite:///{path}")
        await database.write(add, 1)
        held = asyncio.create_task(database.write(add, 2))
        await asyncio.to_thread(begun.wait, 60)
        path.unlink()
        later = asyncio.create_task(database.write(add, 3))
        # If the file is written again too early, it is within this time.
        for _ in range(50):
            if path.exists():
                break
            await asyncio.sleep(0.01)
        gate.set()
        await asyncio.gather(held, later)
        assert await database.read(added) == [1, 2, 3]
        database.close()
        database = Database(f"sqlite:///{path}")
        assert await database.read(added) == [1, 2, 3]
        database.close()

    asyncio.run(run())


def test_jobs_that_failed_at_once_are_bounded(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest finished jobs are forgotten; those with a result, or active, are kept."""
    monkeypatch.setattr("pugeo_service.jobs.manager._LEAST_ROWS", 3)

    async def scenario(house: Any) -> None:
        kept = await house.submit()
        await house.until(kept["id"], "succeeded")
        failed = []
        for _ in range(8):
            failed.append((await house.submit(b"malformed"))["id"])
            await house.http.get(f"/jobs/{failed[-1]}/events")
        await house.until_status(f"/jobs/{failed[4]}", 404)
        listed = [job["id"] for job in (await house.http.get("/jobs")).json()["jobs"]]
        assert listed == [*failed[:4:-1], kept["id"]]

    play(scenario, jobs_queue=3)
