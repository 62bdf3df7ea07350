# SPDX-License-Identifier: Apache-2.0
"""Copy the jobs of a service that may be running, so that another one can go on with them.

    python deploy/backup_jobs.py FOLDER BACKUP

FOLDER is PUGEO_JOBS_DIR. The table comes first and the files after it: a file is complete before
its row, so each row of the copy has its file, unless its job was deleted meanwhile. Files that are
in BACKUP already are not copied again, and those whose job is gone are deleted there. With
PostgreSQL, dump that database first; then only files are copied here. To restore, stop the service
and copy BACKUP to FOLDER.
"""

import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

_TABLE = "jobs.sqlite3"
_FILES = ("inputs", "results")


def main(folder: Path, backup: Path) -> str:
    """Copy the table and the files of jobs; return a line about what was done.

    Raises:
        OSError, sqlite3.Error: something cannot be read or written.
    """
    if not any((folder / name).is_dir() for name in _FILES):
        raise FileNotFoundError(f"{folder} is no folder of jobs: it has no inputs and no results")
    backup.mkdir(mode=0o700, parents=True, exist_ok=True)
    if (folder / _TABLE).exists():
        part = backup / f"{_TABLE}.part"
        part.unlink(missing_ok=True)
        with (
            closing(sqlite3.connect(f"file:{folder / _TABLE}?mode=ro", uri=True)) as table,
            closing(sqlite3.connect(part)) as copy,
        ):
            table.backup(copy)
        part.replace(backup / _TABLE)
    copied = 0
    for name in _FILES:
        (backup / name).mkdir(mode=0o700, exist_ok=True)
        found = {path.name: path for path in (folder / name).iterdir()}
        for stale in {path.name for path in (backup / name).iterdir()} - found.keys():
            (backup / name / stale).unlink()
        for path in found.values():
            copied += _copy(path, backup / name / path.name)
    return f"{copied} files were copied to {backup}"


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
        sys.stdout.write(main(Path(sys.argv[1]), Path(sys.argv[2])) + "\n")
    except (OSError, sqlite3.Error) as failure:
        sys.exit(f"the backup failed: {failure}")
