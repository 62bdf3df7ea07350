# SPDX-License-Identifier: Apache-2.0
"""What a caller hands over, as bytes to send: files verbatim, arrays as NPZ."""

import asyncio
import contextlib
import io
import os
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pugeo_client.errors import SourceError

__all__ = ["Body", "Source", "body_of"]

Source: TypeAlias = (
    str
    | os.PathLike[str]
    | bytes
    | bytearray
    | memoryview
    | BinaryIO
    | NDArray[Any]
    | Mapping[str, Any]
)
"""A path, the bytes of a file, an open binary file, an ``(N, 3)`` or ``(N, 6)`` array (columns 4
to 6 are normals), or a dict of arrays: ``points``, ``normals``, ``colors``, ``scalars``."""

CHUNK = 1 << 18
_MEDIA_TYPES = {
    ".ply": "application/x-ply",
    ".json": "application/json",
    ".npy": "application/x-npy",
    ".npz": "application/x-npz",
    ".xyz": "text/plain",
    ".txt": "text/plain",
}
_UNKNOWN = "application/octet-stream"  # the service looks at the first bytes
_XYZ = 3


class Body:
    """The bytes of one request, readable once more for each retry where that is possible.

    Attributes:
        media_type: for Content-Type.
        length: bytes in all, or None where only reading on would tell.
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
        """Whether `chunks` would still give the whole: false for a pipe that was read from."""
        return self._replayable or not self._begun

    def chunks(self, seen: Callable[[bytes], None]) -> Iterator[bytes]:
        """Give the bytes from the beginning, without ever holding more than a chunk.

        Args:
            seen: called with each chunk before it is given; may raise to stop.
        """
        self._begun = True
        with self._start() as file:
            while chunk := file.read(CHUNK):
                seen(chunk)
                yield chunk

    async def achunks(self, seen: Callable[[bytes], None]) -> AsyncIterator[bytes]:
        """As `chunks`; a slow disk does not hold up the event loop."""
        self._begun = True
        with self._start() as file:
            while chunk := await asyncio.to_thread(file.read, CHUNK):
                seen(chunk)
                yield chunk


def body_of(source: Source) -> Body:
    """Prepare whatever was handed over for sending.

    Raises:
        SourceError: it is nothing of what `Source` lists, or arrays of the wrong shape.
        OSError: the path cannot be read.
    """
    if isinstance(source, (str, os.PathLike)):
        path = Path(source)
        length = path.stat().st_size
        return Body(lambda: path.open("rb"), media_type=_media_type(path.name), length=length)
    if isinstance(source, (bytes, bytearray, memoryview)):
        return _in_memory(bytes(source), _UNKNOWN)
    if isinstance(source, np.ndarray):
        return _in_memory(_npz(_split(source)), _MEDIA_TYPES[".npz"])
    if isinstance(source, Mapping):
        return _in_memory(_npz(source), _MEDIA_TYPES[".npz"])
    if hasattr(source, "read"):
        return _open_file(source)
    raise SourceError(
        f"cannot send a {type(source).__name__}: give a path, bytes, an open binary file, "
        "an (N, 3) or (N, 6) array, or a dict with points"
    )


def _in_memory(data: bytes, media_type: str) -> Body:
    return Body(
        lambda: contextlib.closing(io.BytesIO(data)), media_type=media_type, length=len(data)
    )


def _open_file(file: BinaryIO) -> Body:
    """Send from where the file stands now; the caller's file is left open."""
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


def _split(array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    if array.ndim == 2 and array.shape[1] == 2 * _XYZ:
        return {"points": array[:, :_XYZ], "normals": array[:, _XYZ:]}
    return {"points": array}


def _npz(arrays: Mapping[str, Any]) -> bytes:
    """Pack arrays as the service's own NPZ layout, checking only what it could not explain."""
    unknown = set(arrays) - {"points", "normals", "colors", "scalars"}
    if unknown or arrays.get("points") is None:
        raise SourceError(
            f"a dict of arrays has points, normals, colors, scalars; this one has {sorted(arrays)}"
        )
    scalars = arrays.get("scalars") or {}
    named = {
        name: np.asarray(arrays[name])
        for name in ("points", "normals", "colors")
        if arrays.get(name) is not None
    }
    points = named["points"]
    if points.ndim != 2 or points.shape[1] != _XYZ:
        raise SourceError(f"points must be (N, 3) or (N, 6), not {points.shape}")
    if clashing := {"points", "normals", "colors"} & set(scalars):
        raise SourceError(f"scalars cannot be called {', '.join(sorted(clashing))}")
    named |= {name: np.asarray(values) for name, values in scalars.items()}
    for name, array in named.items():
        if array.dtype.kind not in "fiub" or array.shape[:1] != points.shape[:1]:
            raise SourceError(
                f"{name} must be {len(points)} rows of numbers, not {array.dtype} {array.shape}"
            )
    if points.dtype not in (np.float32, np.float64):
        named["points"] = points.astype(np.float64)
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **named)  # type: ignore[arg-type, unused-ignore]
    return packed.getvalue()
