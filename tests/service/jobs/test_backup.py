# SPDX-License-Identifier: Apache-2.0
"""deploy/backup_jobs.py copies the jobs of a running service."""

import asyncio
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest


def back_up(
    root: Path, folder: Path, backup: Path, store: str = ""
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(root / "deploy/backup_jobs.py"), str(folder), str(backup)]
    environment = os.environ | {"PUGEO_JOBS_STORE": store}
    return subprocess.run(command, check=False, capture_output=True, text=True, env=environment)


def test_another_service_goes_on_with_a_backup(
    root: Path, open_house: Any, database_url: str | None, tmp_path: Path
) -> None:
    """Results are the same bytes, queued jobs are done, and what was deleted stays deleted."""
    if database_url is not None:
        pytest.skip("this is about the table in the folder; PostgreSQL has a dump of its own")
    backup = tmp_path / "backup"

    async def first() -> tuple[Any, ...]:
        async with open_house(jobs_running=1) as house:
            kept, deleted = await house.submit(b"one"), await house.submit(b"two")
            for job in (kept, deleted):
                await house.until(job["id"], "succeeded")
            # The input is removed after the state is told.
            await house.eventually(lambda: not house.names("inputs"))
            done = back_up(root, house.folder, backup)
            assert done.returncode == 0, done.stderr
            assert done.stdout.startswith("2 files were copied")
            await house.http.delete(f"/jobs/{deleted['id']}")
            house.engine.hold.clear()
            queued = [await house.submit(b"three"), await house.submit(b"four")]
            await house.until(queued[0]["id"], "running")
            done = back_up(root, house.folder, backup)
            # Two inputs; the result that was there is not copied again.
            assert done.stdout.startswith("2 files were copied")
            house.engine.hold.set()
            return house.folder, kept, deleted, queued

    folder, kept, deleted, queued = asyncio.run(first())
    assert [path.name for path in (backup / "results").iterdir()] == [kept["id"]]
    shutil.rmtree(folder)
    shutil.copytree(backup, folder)

    async def second() -> None:
        async with open_house() as house:
            await house.until_open()
            assert (await house.http.get(f"/jobs/{kept['id']}/result")).content == b"dense oneone"
            assert (await house.http.get(f"/jobs/{deleted['id']}/result")).status_code == 410
            for job in queued:
                await house.until(job["id"], "succeeded")
            assert {bytes(body) for body in house.engine.began} == {b"three", b"four"}

    asyncio.run(second())


def test_a_folder_without_jobs_is_refused(root: Path, tmp_path: Path) -> None:
    """A mistyped folder is an error, and no empty backup is made."""
    done = back_up(root, tmp_path, tmp_path / "backup")
    assert done.returncode == 1
    assert "is no folder of jobs" in done.stderr
    assert not (tmp_path / "backup").exists()


def test_a_cache_is_no_backup(root: Path, tmp_path: Path) -> None:
    """With a store only the table is copied, and what is left to do is said."""
    folder, backup = tmp_path / "jobs", tmp_path / "backup"
    for name in ("inputs", "results"):
        (folder / name).mkdir(parents=True)
    (folder / "results" / "one").write_bytes(b"a copy")
    refused = back_up(root, folder, backup, "s3://user:secret@jobs")
    assert refused.returncode == 1
    assert "Dump the database first, then copy the store" in refused.stderr
    assert not backup.exists()
    sqlite3.connect(folder / "jobs.sqlite3").close()
    done = back_up(root, folder, backup, "s3://user:secret@jobs")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("only the table was copied")
    assert "Copy the store now" in done.stdout
    assert "secret" not in done.stdout + refused.stderr
    assert [path.name for path in backup.iterdir()] == ["jobs.sqlite3"]
