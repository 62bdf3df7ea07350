# SPDX-License-Identifier: Apache-2.0
"""STL, binary and text: the corners of its triangles as points, each once. Only read."""

import re
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Declared, Limits
from pugeo_model.formats.stream import CHUNK_BYTES, bytes_left

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "declared", "read", "sniff"]

NAME = "stl"
EXTENSIONS: tuple[str, ...] = (".stl",)
MEDIA_TYPES: tuple[str, ...] = ("model/stl", "application/sla")

_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_TEXT = re.compile(rb"\s*solid\b[^\r\n]*[\r\n]+\s*(facet|endsolid)\b")
_VERTEX = re.compile(rb"vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)")


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is STL as text; binary STL has no mark of its own."""
    return _TEXT.match(head) is not None


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read the corners of all triangles; equal corners become one point.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the corners, three for each triangle.

    Raises:
        MalformedFileError: neither kind of STL, or truncated.
        LimitExceededError: more corners than ``limits``.
    """
    start = file.tell()
    text = sniff(file.read(4096))
    file.seek(start)
    corners = _read_text(file, limits) if text else _read_binary(file, limits)
    rows = np.ascontiguousarray(corners)
    # Equal bytes, not equal numbers: NaN stays, and cleaning drops it.
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).ravel()
    first = np.sort(np.unique(keys, return_index=True)[1]) if len(rows) else np.empty(0, np.int64)
    note = (
        f"The file is a mesh: its {len(corners) // 3:,} triangles are dropped, and their "
        f"{len(first):,} corners alone are taken as the scan."
    )
    return Cloud(rows[first], notes=(note,), source=SourceInfo("stl"))


def declared(file: IO[bytes], limits: Limits) -> Declared | None:
    """Return the number of corners as a binary file states it; ``None`` of a text file.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the corners.

    Raises:
        MalformedFileError, LimitExceededError: as `read`.
    """
    start = file.tell()
    text = sniff(file.read(4096))
    file.seek(start)
    return None if text else Declared(3 * _count(file, limits), 12)


def _read_binary(file: IO[bytes], limits: Limits) -> NDArray[np.float32]:
    count = _count(file, limits)
    rows = np.frombuffer(file.read(count * _TRIANGLE.itemsize), _TRIANGLE)
    return rows["corners"].reshape(-1, 3).astype(np.float32)


def _count(file: IO[bytes], limits: Limits) -> int:
    """Read the header of a binary file; return the number of triangles."""
    found = bytes_left(file)
    header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        raise MalformedFileError(
            "The file is no STL: it is shorter than the header of 84 bytes.", code="truncated"
        )
    count = int.from_bytes(header[80:], "little")
    limits.check("max_points", 3 * count, "Corners of the STL file")
    if _HEADER_BYTES + count * _TRIANGLE.itemsize > found:
        raise MalformedFileError(
            f"The STL file ends too early: {count:,} triangles take "
            f"{_HEADER_BYTES + count * _TRIANGLE.itemsize:,} bytes, found {found:,}.",
            code="truncated",
            expected_rows=count,
            found_rows=max(0, found - _HEADER_BYTES) // _TRIANGLE.itemsize,
        )
    return count


def _read_text(file: IO[bytes], limits: Limits) -> NDArray[np.float64]:
    blocks: list[NDArray[np.float64]] = []
    count, rest = 0, b""
    while chunk := file.read(CHUNK_BYTES):
        data = rest + chunk
        # A line that the chunk ends in waits for its end; no line of STL is long.
        cut = data.rfind(b"\n") + 1 or data.rfind(b"\r") + 1
        whole, rest = data[:cut], data[cut:][-4096:]
        blocks.append(_corners(whole))
        count += len(blocks[-1])
        limits.check("max_points", count, "Corners of the STL file, at least")
    blocks.append(_corners(rest))
    corners = np.concatenate(blocks)
    if len(corners) % 3 or not len(corners):
        raise MalformedFileError(
            f"The STL file has {len(corners):,} corners, which are no whole triangles.",
            code="truncated",
        )
    return corners


def _corners(text: bytes) -> NDArray[np.float64]:
    tokens = [token for row in _VERTEX.findall(text) for token in row]
    try:
        return np.array(tokens, "S").astype(np.float64).reshape(-1, 3)
    except ValueError as error:
        raise MalformedFileError(
            f"A corner of the STL file is no number: {str(error)[:80]}.", code="not_a_number"
        ) from error
