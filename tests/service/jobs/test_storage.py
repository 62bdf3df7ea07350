# SPDX-License-Identifier: Apache-2.0
"""Full disks, folders that are not writable, failing databases."""

import asyncio
import errno
import gc
import os
import socket
import sqlite3
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from pugeo_service.engine import DiskError
from pugeo_service.jobs import database as database_module
from pugeo_service.jobs import repository
from pugeo_service.jobs.database import Database
from pugeo_service.problems import ProblemError


def fail(number: int) -> Any:
    def raising(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    return raising


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_a_full_disk(play: Any, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """An error at any step is a 503 with Retry-After, and neither file nor row is left."""
    target = {
        "write": "pugeo_service.storage.atomic_file.AtomicFile._store",
        "fsync": "pugeo_service.storage.atomic_file.os.fsync",
        "replace": "pugeo_service.storage.atomic_file.Path.replace",
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
    """Another error of the disk is a 503 that reveals no path."""

    async def scenario(house: Any) -> None:
        monkeypatch.setattr("pugeo_service.storage.atomic_file.os.fsync", fail(errno.EIO))
        answer = await house.http.post("/jobs", content=b"x")
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_failed")
        assert str(house.folder) not in answer.text

    play(scenario)


def test_no_room_for_a_result(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The job is repeated later; it fails if the disk stays full."""
    monkeypatch.setattr("pugeo_service.jobs.completion._REPAIR_S", 0.05)

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        with monkeypatch.context() as patch:
            patch.setattr("pugeo_service.storage.atomic_file.os.fsync", fail(errno.ENOSPC))
            house.engine.hold.set()
            failed = await house.until(job["id"], "failed")
        assert (failed["attempts"], failed["problem"]["code"]) == (2, "storage_full")
        assert house.names("results") == house.names("parts") == []

    play(scenario, jobs_attempts=2)


def test_a_disk_that_fails_the_engine(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the engine finds the disk full, a job is repeated and a request gets 503."""
    monkeypatch.setattr("pugeo_service.jobs.completion._REPAIR_S", 0.05)

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
    """A body that does not fit is refused; a smaller one is accepted afterwards."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post("/jobs", content=b"x" * (3 << 20))
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")
        assert house.names("inputs") == house.names("parts") == []
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario, jobs_dir=small_disk / "jobs")


def remount(folder: Path, mode: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{mode}", str(folder)], check=True)


def test_a_folder_that_is_read_only(play: Any, small_disk: Path) -> None:
    """On a read-only file system jobs are refused; they are accepted once it is writable."""
    remount(small_disk, "ro")

    async def scenario(house: Any) -> None:
        refused = await house.http.post("/jobs", content=b"x")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert (await house.http.post("/upsample", content=b"x")).status_code == 200
        remount(small_disk, "rw")
        await house.until_open()
        await house.until((await house.submit())["id"], "succeeded")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pugeo_service.jobs.manager._REOPEN_S", 0.05)
        play(scenario, jobs_dir=small_disk / "jobs")


def test_a_folder_that_is_none(play: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only jobs are refused, and are accepted as soon as the folder can be made."""
    monkeypatch.setattr("pugeo_service.jobs.manager._REOPEN_S", 0.05)
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
    """A connection that can lock the database."""
    if database_url is not None:
        pytest.skip("a lock on the whole database is SQLite's")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pugeo_service.jobs.database._BUSY_S", 0.3)
        (tmp_path / "jobs").mkdir()
        connection = sqlite3.connect(tmp_path / "jobs" / "jobs.sqlite3", isolation_level=None)
        yield connection
        connection.close()


def test_a_database_that_is_locked(play: Any, locked: sqlite3.Connection) -> None:
    """A submission gets 503, and no file is left; after the lock jobs are accepted."""

    async def scenario(house: Any) -> None:
        locked.execute("BEGIN EXCLUSIVE")
        refused = await house.http.post("/jobs", content=b"x")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert house.names("inputs") == []
        locked.execute("ROLLBACK")
        await house.until((await house.submit())["id"], "succeeded")

    play(scenario)


def test_waiting_for_a_lock_does_not_block(
    play: Any, locked: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a submission waits for a lock of the database, other requests are answered."""
    monkeypatch.setattr("pugeo_service.jobs.database._BUSY_S", 600.0)

    async def scenario(house: Any) -> None:
        locked.execute("BEGIN EXCLUSIVE")
        call = asyncio.create_task(house.http.post("/jobs", content=b"x"))
        await house.eventually(lambda: house.names("inputs") != [])
        for _ in range(20):
            assert (await house.http.get("/health/live")).status_code == 200
        assert not call.done()
        locked.execute("ROLLBACK")
        assert (await call).status_code == 202

    play(scenario)


def test_a_database_that_fails_at_the_end_of_a_job(
    play: Any, locked: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The outcome is stored once the database works again; the job runs only once."""
    failures: list[str] = []
    unavailable = database_module.unavailable

    def counted(reason: str) -> ProblemError:
        failures.append(reason)
        return unavailable(reason)

    monkeypatch.setattr(database_module, "unavailable", counted)

    async def scenario(house: Any) -> None:
        house.engine.hold.clear()
        job = await house.submit()
        await house.until(job["id"], "running")
        locked.execute("BEGIN EXCLUSIVE")
        house.engine.hold.set()
        await house.eventually(lambda: house.names("results") == [job["id"]])
        await house.eventually(lambda: len(failures) >= 3)
        locked.execute("ROLLBACK")
        await house.until(job["id"], "succeeded")
        assert house.engine.began == [b"cloud"]

    play(scenario)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_database_that_says_nothing(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A database that never responds delays neither start nor shutdown."""
    pytest.importorskip("pg8000")
    monkeypatch.setattr("pugeo_service.jobs.database._RESPONSE_S", 0.2)

    async def scenario(house: Any) -> None:
        refused = await house.http.get("/jobs")
        assert (refused.status_code, refused.json()["code"]) == (503, "jobs_unavailable")
        assert (await house.http.post("/upsample", content=b"x")).status_code == 200

    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"postgresql://pugeo:secret@127.0.0.1:{silent.getsockname()[1]}/jobs"
        play(scenario, database_url=url)
    # The driver does not close sockets of failed attempts; collect them within this test.
    gc.collect()


@pytest.mark.postgres
def test_services_that_make_the_table_at_once(postgres: Any) -> None:
    """Several services can create the table at the same time."""
    url, together = postgres(), threading.Barrier(4)

    def use() -> int:
        database = Database(url)
        together.wait()
        try:
            return asyncio.run(database.read(repository.usage)).queued
        finally:
            database.close()

    with ThreadPoolExecutor(4) as threads:
        assert [each.result() for each in [threads.submit(use) for _ in range(4)]] == [0] * 4


def test_sync_requests_on_a_full_disk(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A body of /upsample that cannot be stored is a 503 too."""

    async def scenario(house: Any) -> None:
        monkeypatch.setattr("pugeo_service.storage.spool.Spool._store", fail(errno.ENOSPC))
        answer = await house.http.post("/upsample", content=b"x" * (2 << 20))
        assert (answer.status_code, answer.json()["code"]) == (503, "storage_full")

    play(scenario)


def test_whose_folder_it_is(tmp_path: Path) -> None:
    """A folder of another user within a shared folder is refused."""
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
