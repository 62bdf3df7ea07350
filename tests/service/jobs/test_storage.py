# SPDX-License-Identifier: Apache-2.0
"""Disks that are full, folders that cannot be written to, databases that fail."""

import asyncio
import errno
import gc
import os
import socket
import sqlite3
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.engine import DiskError
from pugeo_service.jobs import client_queries
from pugeo_service.jobs.database import Database


def fail(number: int) -> Any:
    def raising(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    return raising


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_full_disk(play: Any, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """Wherever it shows, the answer is 503 with Retry-After, and no file and no row are left."""
    target = {
        "write": "pugeo_service.jobs.files.NewFile._store",
        "fsync": "pugeo_service.jobs.files.os.fsync",
        "replace": "pugeo_service.jobs.files.Path.replace",
    }[step]

    async def scenario(house: Any) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(target, fail(errno.ENOSPC))
            answer = await house.http.post("/jobs", content=b"x" * (2 << 20))
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")
        assert answer.json()["retryable"] is True
        assert int(answer.headers["retry-after"]) > 0
        assert house.names("inputs") == house.names("parts") == []
        assert (await house.http.get("/jobs")).json()["jobs"] == []
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario)


def test_a_disk_that_fails_otherwise(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of input or output is a 503 of its own, and tells no paths."""

    async def scenario(house: Any) -> None:
        monkeypatch.setattr("pugeo_service.jobs.files.os.fsync", fail(errno.EIO))
        answer = await house.http.post("/jobs", content=b"x")
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_failed")
        assert str(house.folder) not in answer.text

    play(scenario)


def test_no_room_for_a_result(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The job is begun again later; if there is never room, it fails and says so."""
    monkeypatch.setattr("pugeo_service.jobs.completion._STORAGE_BACK_S", 0.05)

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        with monkeypatch.context() as patch:
            patch.setattr("pugeo_service.jobs.files.os.fsync", fail(errno.ENOSPC))
            house.engine.hold.set()
            failed = await house.until(job["id"], "failed")
        assert (failed["attempts"], failed["problem"]["code"]) == (2, "storage_full")
        assert house.names("results") == house.names("parts") == []

    play(scenario, jobs_attempts=2)


def test_a_disk_that_fails_the_engine(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the engine finds it full, a job is begun again and a request gets a 503."""
    monkeypatch.setattr("pugeo_service.jobs.completion._STORAGE_BACK_S", 0.05)

    async def scenario(house: Any) -> None:
        full = [True, True]

        def go_wrong(_: bytes) -> None:
            if full:
                full.pop()
                raise DiskError(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

        house.engine._go_wrong = go_wrong
        answer = await house.http.post("/upsample", content=b"x")
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")
        assert "retry-after" in answer.headers
        job = await house.submit()
        assert (await house.until(job["id"], "succeeded", "failed"))["attempts"] == 2

    play(scenario)


@pytest.fixture
def small_disk() -> Iterator[Path]:
    """A file system of 1 MiB."""
    # Not in pytest's own folder, which it could not clear if this were left behind.
    folder = Path(tempfile.mkdtemp(prefix="pugeo-small-disk-"))
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "pugeo-test", str(folder)]
    if os.geteuid() or subprocess.run(command, check=False, capture_output=True).returncode:
        folder.rmdir()
        pytest.skip("making a small file system takes more rights than this has")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        folder.rmdir()


def test_a_disk_that_is_really_full(play: Any, small_disk: Path) -> None:
    """A body that does not fit is refused; one that does is done afterwards."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post("/jobs", content=b"x" * (3 << 20))
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")
        assert house.names("inputs") == house.names("parts") == []
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario, jobs_dir=small_disk / "jobs")


def remount(folder: Path, mode: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{mode}", str(folder)], check=True)


def test_a_folder_that_is_read_only(play: Any, small_disk: Path) -> None:
    """On a read-only file system jobs are refused with a reason; when it is mended they open."""
    remount(small_disk, "ro")

    async def scenario(house: Any) -> None:
        refused = await house.http.post("/jobs", content=b"x")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert (await house.http.post("/upsample", content=b"x")).status_code == 200
        remount(small_disk, "rw")
        await house.until_open()
        await house.until((await house.submit())["id"], "succeeded")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pugeo_service.jobs.manager._AGAIN_S", 0.05)
        play(scenario, jobs_dir=small_disk / "jobs")


def test_a_folder_that_is_none(play: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything but jobs works meanwhile, and jobs as soon as the folder can be made."""
    monkeypatch.setattr("pugeo_service.jobs.manager._AGAIN_S", 0.05)
    (tmp_path / "taken").write_bytes(b"")

    async def scenario(house: Any) -> None:
        for path in ("/jobs", "/jobs/some", "/jobs/some/events", "/jobs/some/result"):
            refused = await house.http.get(path)
            assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
            assert "retry-after" in refused.headers
        assert (await house.http.post("/upsample", content=b"x")).status_code == 200
        (tmp_path / "taken").unlink()
        await house.until_open()
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario, jobs_dir=tmp_path / "taken" / "jobs")


@pytest.fixture
def locked(tmp_path: Path, database_url: str | None) -> Iterator[sqlite3.Connection]:
    """A connection that can keep everybody else from writing."""
    if database_url is not None:
        pytest.skip("a lock on the whole database is SQLite's")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pugeo_service.jobs.database._BUSY_S", 0.3)
        (tmp_path / "jobs").mkdir()
        connection = sqlite3.connect(tmp_path / "jobs" / "jobs.sqlite3", isolation_level=None)
        yield connection
        connection.close()


def test_a_database_that_is_locked(play: Any, locked: sqlite3.Connection) -> None:
    """The answer is 503, nothing is left behind, the event loop runs on; later all is well."""

    async def scenario(house: Any) -> None:
        locked.execute("BEGIN EXCLUSIVE")
        call = asyncio.create_task(house.http.post("/jobs", content=b"x"))
        slowest, last = 0.0, time.monotonic()
        while not call.done():
            await asyncio.sleep(0.005)
            slowest, last = max(slowest, time.monotonic() - last), time.monotonic()
        refused = await call
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert slowest < 0.25, "the event loop waited for the database"
        assert house.names("inputs") == []
        locked.execute("ROLLBACK")
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario)


def test_a_database_that_fails_at_the_end_of_a_job(play: Any, locked: sqlite3.Connection) -> None:
    """The end is noted as soon as that is possible; the work is not done twice."""

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        locked.execute("BEGIN EXCLUSIVE")
        house.engine.hold.set()
        await house.eventually(lambda: house.names("results") == [job["id"]])
        await asyncio.sleep(0.5)
        locked.execute("ROLLBACK")
        await house.until(job["id"], "succeeded")
        assert house.engine.began == [b"cloud"]

    play(scenario)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_database_that_says_nothing(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that takes connections and never answers keeps neither the start nor the end waiting."""
    pytest.importorskip("pg8000")
    monkeypatch.setattr("pugeo_service.jobs.database._SILENCE_S", 0.2)

    async def scenario(house: Any) -> None:
        refused = await house.http.get("/jobs")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert (await house.http.post("/upsample", content=b"x")).status_code == 200

    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"postgresql://pugeo:secret@127.0.0.1:{silent.getsockname()[1]}/jobs"
        play(scenario, database_url=url)
    # The driver leaves the sockets of failed attempts behind; they go here, not in other tests.
    gc.collect()


@pytest.mark.postgres
def test_services_that_make_the_table_at_once(postgres: Any) -> None:
    """Of several that find an empty database none fails."""
    url, together = postgres(), threading.Barrier(4)

    def use() -> int:
        database = Database(url)
        together.wait()
        try:
            return asyncio.run(database.read(client_queries.usage)).queued
        finally:
            database.close()

    with ThreadPoolExecutor(4) as threads:
        assert [each.result() for each in [threads.submit(use) for _ in range(4)]] == [0] * 4


def test_sync_requests_on_a_full_disk(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A body of /upsample that cannot be spooled is told the same way."""

    async def scenario(house: Any) -> None:
        monkeypatch.setattr("pugeo_service.storage.spool.Spool._store", fail(errno.ENOSPC))
        answer = await house.http.post("/upsample", content=b"x" * (2 << 20))
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")

    play(scenario)


def test_whose_folder_it_is(tmp_path: Path) -> None:
    """Where everybody may leave things, the folder of another user is not used."""
    from pugeo_service.jobs.files import JobFiles

    if os.geteuid():
        pytest.skip("making a file of another user takes more rights than this has")
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "jobs").mkdir()
    os.chown(shared / "jobs", 12345, -1)
    with pytest.raises(PermissionError, match="another user"):
        JobFiles(shared / "jobs", "me").prepare()
    JobFiles(shared / "own", "me").prepare()
    assert (shared / "own").stat().st_mode & 0o777 == 0o700
