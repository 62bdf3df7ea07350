# SPDX-License-Identifier: Apache-2.0
"""Bytes in and out: paths, open files, spooled uploads, pipes."""

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from pugeo_model.formats.limits import Limits

__all__ = ["CHUNK_BYTES", "Source", "Target", "bytes_left", "is_stream", "replacing", "seekable"]

Source = str | os.PathLike[str] | IO[bytes]
Target = str | os.PathLike[str] | IO[bytes]

# Large enough to hide Python's cost for each chunk; small enough to stay in the cache and to
# give the interpreter back to other threads every few milliseconds.
CHUNK_BYTES = 1 << 19

_SPOOL_BYTES = 1 << 24


def bytes_left(file: IO[bytes]) -> int:
    """Count the bytes from the current position to the end; the position stays."""
    here = file.tell()
    file.seek(0, os.SEEK_END)
    end = file.tell()
    file.seek(here)
    return end - here


@contextmanager
def seekable(source: Source, limits: Limits) -> Iterator[IO[bytes]]:
    """Give a file that can be measured, whatever the source is.

    A pipe is copied into a spooled temporary file; a file handed in stays open.

    Args:
        source: path, or binary file positioned at the cloud's first byte.
        limits: ``max_bytes`` bounds the file, and the copy of a pipe.

    Raises:
        LimitExceededError: more than ``max_bytes``.
        OSError: the path cannot be read.
    """
    if isinstance(source, str | os.PathLike):
        with Path(source).open("rb") as file, seekable(file, limits) as inner:
            yield inner
    elif source.seekable():
        limits.check("max_bytes", bytes_left(source), "Bytes of the file")
        yield source
    else:
        with tempfile.SpooledTemporaryFile(max_size=_SPOOL_BYTES) as spool:
            size = 0
            while chunk := source.read(CHUNK_BYTES):
                size += len(chunk)
                limits.check("max_bytes", size, "Bytes of the stream")
                spool.write(chunk)
            spool.seek(0)
            yield spool


@contextmanager
def replacing(target: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a file for an atomic write: it replaces the target once it is complete.

    The bytes go to a temporary file next to ``target``, which is renamed over it on a clean
    exit and removed after an exception: readers see the old file or the whole new one.
    A device, a pipe or a descriptor (``/dev/stdout``) is never replaced: the bytes are copied into
    it at the end.

    Raises:
        OSError: the folder is missing or not writable.
    """
    path = Path(target)
    if is_stream(path):
        with tempfile.TemporaryFile() as file:
            yield file
            file.seek(0)
            with path.open("ab") as stream:
                shutil.copyfileobj(file, stream, CHUNK_BYTES)
        return
    path = path.resolve()
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    # Not tempfile: its files are private (0600), and the umask should decide as for any new file.
    descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def is_stream(path: Path) -> bool:
    """Return whether a path is a device, a pipe, a socket or a descriptor of this process."""
    # /dev/stdout and /proc/self/fd/1 may lead to a regular file that others hold open.
    if path.is_absolute() and path.parts[1:2] in {("dev",), ("proc",)}:
        return path.exists()
    return path.exists() and not path.is_file() and not path.is_dir()
