# SPDX-License-Identifier: Apache-2.0
"""Input of a request as bytes to send: files unchanged, arrays as NPZ."""

import asyncio
import contextlib
import io
import os
import stat
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from numpy.typing import ArrayLike

from pugeo_client._arrays import pack_npz, to_cloud_arrays
from pugeo_client.errors import SourceError

__all__ = ["Body", "Source", "make_body"]

Source: TypeAlias = (
    str
    | os.PathLike[str]
    | bytes
    | bytearray
    | memoryview
    | BinaryIO
    | ArrayLike
    | Mapping[str, Any]
    | Any
)
"""A path, the bytes of a file, an open binary file; an ``(N, 3)`` or ``(N, 6)`` array, list or
torch tensor (columns 4 to 6 are normals); an Open3D point cloud; or a dict of arrays: ``points``,
``normals``, ``colors``, ``scalars`` (itself a dict)."""

CHUNK = 1 << 18
_MEDIA_TYPES = {
    ".ply": "application/x-ply",
    ".json": "application/json",
    ".npy": "application/x-npy",
    ".npz": "application/x-npz",
    ".xyz": "text/plain",
    ".txt": "text/plain",
}
_UNKNOWN = "application/octet-stream"  # the service detects the format by the content


class Body:
    """Body of a request, read again for each retry where that is possible.

    Args:
        start: opens the content at its beginning.
        media_type: for Content-Type.
        length: total in bytes, or None for a pipe.
        replayable: whether ``start`` may be called again.

    Attributes:
        media_type: as above.
        length: as above.
    """

    def __init__(
        self,
        start: Callable[[], AbstractContextManager[BinaryIO]],
        *,
        media_type: str,
        length: int | None,
        replayable: bool = True,
    ) -> None:
        self.media_type = media_type
        self.length = length
        self._start = start
        self._replayable = replayable
        self._begun = False

    @property
    def sendable(self) -> bool:
        """True while `chunks` yields the whole content (again); false once a pipe was read."""
        return self._replayable or not self._begun

    def chunks(self, count: Callable[[bytes], None]) -> Iterator[bytes]:
        """Yield the content from its beginning; only one chunk is in memory.

        Args:
            count: called with each chunk before it is yielded; may raise to stop.
        """
        self._begun = True
        with self._start() as file:
            while chunk := file.read(CHUNK):
                count(chunk)
                yield chunk

    async def achunks(self, count: Callable[[bytes], None]) -> AsyncIterator[bytes]:
        """As `chunks`, read in a thread, so that a slow disk does not block the event loop."""
        self._begun = True
        with self._start() as file:
            while chunk := await asyncio.to_thread(file.read, CHUNK):
                count(chunk)
                yield chunk


def make_body(source: Source) -> Body:
    """Prepare an input for sending.

    Raises:
        SourceError: it is nothing that `Source` lists, or arrays of the wrong shape or type.
        OSError: the path cannot be read.
    """
    if isinstance(source, (str, os.PathLike)):
        path = Path(source)
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise SourceError(f"{path} is a folder; give its files to map()")
        if not stat.S_ISREG(status.st_mode):  # a pipe has no length and is read once
            return Body(lambda: path.open("rb"), media_type=_UNKNOWN, length=None, replayable=False)
        return Body(
            lambda: path.open("rb"), media_type=_media_type(path.name), length=status.st_size
        )
    if isinstance(source, (bytes, bytearray, memoryview)):
        return _in_memory(bytes(source), _UNKNOWN)
    if hasattr(source, "read"):
        return _open_file(source)
    return _in_memory(pack_npz(to_cloud_arrays(source)), _MEDIA_TYPES[".npz"])


def _in_memory(data: bytes, media_type: str) -> Body:
    return Body(
        lambda: contextlib.closing(io.BytesIO(data)), media_type=media_type, length=len(data)
    )


def _open_file(file: Any) -> Body:
    """Send a file from its present position; it stays open."""
    if isinstance(file, io.TextIOBase):
        raise SourceError("the file is open in text mode; open it with 'rb'")
    name = getattr(file, "name", "")
    media_type = _media_type(name if isinstance(name, str) else "")
    if not (hasattr(file, "seekable") and file.seekable()):
        return Body(
            lambda: contextlib.nullcontext(file),
            media_type=media_type,
            length=None,
            replayable=False,
        )
    begin = file.tell()
    length = file.seek(0, os.SEEK_END) - begin
    file.seek(begin)

    def rewound() -> AbstractContextManager[BinaryIO]:
        file.seek(begin)
        return contextlib.nullcontext(file)

    return Body(rewound, media_type=media_type, length=length)


def _media_type(name: str) -> str:
    return _MEDIA_TYPES.get(Path(name).suffix.lower(), _UNKNOWN)
