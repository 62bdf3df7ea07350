# SPDX-License-Identifier: Apache-2.0
"""Atomic writing of files: the complete new content, or the old file as it was."""

import contextlib
import errno
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

__all__ = ["atomic_file", "check_writable"]


def check_writable(path: Path) -> None:
    """Check that a file can be written at ``path``, without writing.

    Raises:
        OSError: it is a folder, its folder does not exist, or the rights are missing.
    """
    target = Path(os.path.realpath(path))
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "the output file is a folder", str(path))
    if _is_stream(path):
        return
    if not target.parent.is_dir():
        raise FileNotFoundError(
            errno.ENOENT, "the folder of the output file does not exist", str(target.parent)
        )
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise PermissionError(errno.EACCES, "the output file cannot be written", str(path))


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces ``path`` when the block ends without an error.

    After an error the temporary file is removed and an older file at ``path`` is unchanged.
    A file that is replaced keeps its permission bits; of a symbolic link the target is replaced.
    A device or a pipe is never replaced: the content is copied into it at the end of the block.

    Yields:
        A binary file, open for writing and reading.

    Raises:
        OSError: as `check_writable`, or the disk is full.
    """
    check_writable(path)
    if _is_stream(path):
        with tempfile.TemporaryFile() as file:
            yield file
            file.seek(0)
            with path.open("ab") as stream:
                shutil.copyfileobj(file, stream)
        return
    target = Path(os.path.realpath(path))
    # In the same folder: a rename is atomic only within one file system.
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with part.open("x+b") as file:
            if target.exists():
                part.chmod(stat.S_IMODE(target.stat().st_mode))
            yield file
        os.replace(part, target)  # noqa: PTH105 - Path.rename does not replace on Windows
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _is_stream(path: Path) -> bool:
    """Tell whether ``path`` is a device, a pipe, a socket or a descriptor of this process."""
    # /dev/stdout and /proc/self/fd/1 may lead to a regular file that others hold open.
    if path.is_absolute() and path.parts[1:2] in {("dev",), ("proc",)}:
        return path.exists()
    return path.exists() and not path.is_file() and not path.is_dir()
