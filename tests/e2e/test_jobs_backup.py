# SPDX-License-Identifier: Apache-2.0
"""deploy/backup_jobs.py copies the jobs of a running service."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pugeo_client import Client


def back_up(root: Path, folder: Path, backup: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(root / "deploy/backup_jobs.py"), str(folder), str(backup)]
    return subprocess.run(command, check=False, capture_output=True, text=True)


@pytest.mark.slow
def test_another_service_goes_on_with_a_backup(
    root: Path, launch: Any, sphere: Any, tmp_path: Path
) -> None:
    """Results of a backup are the same bytes, and what was deleted before it stays deleted."""
    folder, backup, restored = (tmp_path / name for name in ("jobs", "backup", "restored"))
    with launch("--workers", "1", PUGEO_JOBS_DIR=str(folder)) as server:
        server.wait_until_ready()
        with Client(server.url) as client:
            kept, deleted = (client.submit(sphere, ratio=ratio) for ratio in (4, 2))
            points = kept.wait().result().points
            deleted.wait()
            first = back_up(root, folder, backup)
            assert first.returncode == 0, first.stderr
            deleted.cancel()  # it has ended: its result is deleted
            late = client.submit(sphere, ratio=3)
            late.wait()
            second = back_up(root, folder, backup)
    assert first.stdout.startswith("2 files were copied")
    assert second.stdout.startswith("1 files were copied")
    # To restore is to copy.
    shutil.copytree(backup, restored)
    with launch("--workers", "1", PUGEO_JOBS_DIR=str(restored)) as server:
        server.wait_until_ready()
        with Client(server.url) as client:
            again = client.job(kept.id)
            assert again.state == "succeeded"
            assert (again.result().points == points).all()
            assert client.job(late.id).state == "succeeded"
            assert client.job(deleted.id).state == "expired"


def test_a_folder_without_jobs_is_refused(root: Path, tmp_path: Path) -> None:
    """A mistyped folder is an error, and no empty backup is made."""
    done = back_up(root, tmp_path, tmp_path / "backup")
    assert done.returncode == 1
    assert "is no folder of jobs" in done.stderr
    assert not (tmp_path / "backup").exists()
