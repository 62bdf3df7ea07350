# SPDX-License-Identifier: Apache-2.0
"""Copy the jobs of a service that may be running, so that another one can go on with them.

    python deploy/backup_jobs.py FOLDER BACKUP

FOLDER is PUGEO_JOBS_DIR. The table comes first and the files after it: a file is complete before
its row, so each row of the copy has its file, unless its job was deleted meanwhile. Files that are
in BACKUP already are not copied again, and those whose job is gone are deleted there. With
PostgreSQL, dump that database first; then only files are copied here. To restore, stop the service
and copy BACKUP to FOLDER.

With PUGEO_JOBS_STORE in the environment the files in FOLDER are a cache, and are not copied. Copy
the store itself, after the table.
"""

import os
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

_TABLE = "jobs.sqlite3"
_FILES = ("inputs", "results")


def main(folder: Path, backup: Path, *, stored: bool) -> str:
    """Copy the table and the files of jobs; return a line about what was done.

    Args:
        folder: of jobs.
        backup: gets the copies.
        stored: the files of jobs are in a store; then only the table is copied.

    Raises:
        OSError, sqlite3.Error: something cannot be read or written.
    """
    if not any((folder / name).is_dir() for name in _FILES):
        raise FileNotFoundError(f"{folder} is no folder of jobs: it has no inputs and no results")
    has_table = (folder / _TABLE).exists()
    if stored and not has_table:
        raise FileNotFoundError(
            f"{folder} has nothing to copy: it has no table, and with PUGEO_JOBS_STORE its files "
            "are a cache. Dump the database first, then copy the store"
        )
    backup.mkdir(mode=0o700, parents=True, exist_ok=True)
    if has_table:
        _copy_table(folder, backup)
    if stored:
        return (
            f"only the table was copied to {backup}: with PUGEO_JOBS_STORE the files in {folder} "
            "are a cache. Copy the store now"
        )
    copied = 0
    for name in _FILES:
        (backup / name).mkdir(mode=0o700, exist_ok=True)
        found = {path.name: path for path in (folder / name).iterdir()}
        for stale in {path.name for path in (backup / name).iterdir()} - found.keys():
            (backup / name / stale).unlink()
        for path in found.values():
            copied += _copy(path, backup / name / path.name)
    return f"{copied} files were copied to {backup}"


def _copy_table(folder: Path, backup: Path) -> None:
    part = backup / f"{_TABLE}.part"
    part.unlink(missing_ok=True)
    with (
        closing(sqlite3.connect(f"file:{folder / _TABLE}?mode=ro", uri=True)) as table,
        closing(sqlite3.connect(part)) as copy,
    ):
        table.backup(copy)
    part.replace(backup / _TABLE)


def _copy(path: Path, target: Path) -> bool:
    """Copy a file that is not there yet; it appears whole or not at all."""
    if target.exists():
        return False
    part = target.with_name(f"{target.name}.part")
    try:
        shutil.copy2(path, part)
    except FileNotFoundError:  # its job was deleted
        part.unlink(missing_ok=True)
        return False
    part.replace(target)
    return True


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python deploy/backup_jobs.py FOLDER BACKUP")
    try:
        kept_in_store = bool(os.environ.get("PUGEO_JOBS_STORE"))
        done = main(Path(sys.argv[1]), Path(sys.argv[2]), stored=kept_in_store)
        sys.stdout.write(done + "\n")
    except (OSError, sqlite3.Error) as failure:
        sys.exit(f"the backup failed: {failure}")
