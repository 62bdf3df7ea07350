# SPDX-License-Identifier: Apache-2.0
"""Check that a received file is the cloud it should be, before it replaces anything.

The points are counted without being parsed, in chunks, so that memory stays bounded.
"""

import os
from collections.abc import Callable, Iterator
from typing import BinaryIO

import numpy as np

from pugeo_client._npz import npy_shape, npz_shapes
from pugeo_client._ply import MAX_HEADER_BYTES, read_header
from pugeo_client.errors import InvalidResponseError

__all__ = ["verify_cloud"]

_CHUNK = 1 << 20
_ROWS_DEPTH = 3  # {"points": [[x, y, z], ...]}: a row is the third bracket


def verify_cloud(file: BinaryIO, format: str, points: int | None) -> None:
    """Check the format, the length and the number of points of a cloud.

    Args:
        file: the whole answer, seekable.
        format: name of its format; one that is not known here is only told from a web page.
        points: the number that the service stated, or None.

    Raises:
        InvalidResponseError: it is another one.
    """
    file.seek(0)
    beginning = file.read(MAX_HEADER_BYTES)
    if beginning.lstrip()[:1] == b"<":
        raise InvalidResponseError(
            "the answer is a web page, perhaps of a proxy or a login, and no point cloud"
        )
    if format not in _COUNTERS:
        return
    found = _COUNTERS[format](file, beginning)
    if points is not None and found != points:
        raise InvalidResponseError(f"the answer has {found} points, and its headers say {points}")


def _count_ply(file: BinaryIO, beginning: bytes) -> int:
    header = read_header(beginning)
    if header.ascii:
        return _count_lines(file, header.start)
    size = file.seek(0, os.SEEK_END) - header.start
    if size != header.points * header.dtype.itemsize:
        raise InvalidResponseError(
            f"the answer promises {header.points} points of {header.dtype.itemsize} bytes "
            f"but has {size} bytes"
        )
    return header.points


def _count_npz(file: BinaryIO, _: bytes) -> int:
    shapes = npz_shapes(file)
    points = shapes.get("points", ())
    if len(points) != 2 or points[1] != 3 or any(s[:1] != points[:1] for s in shapes.values()):
        raise InvalidResponseError(f"the answer is no cloud: its arrays have the shapes {shapes}")
    return points[0]


def _count_npy(file: BinaryIO, _: bytes) -> int:
    shape = npy_shape(file)
    if len(shape) != 2 or shape[1] < 3:
        raise InvalidResponseError(f"the answer is no cloud: its array has the shape {shape}")
    return shape[0]


def _count_xyz(file: BinaryIO, beginning: bytes) -> int:
    """Count the lines after the comment in which the service names the columns."""
    comment, line_end, _ = beginning.partition(b"\n")
    start = len(comment) + len(line_end) if comment.startswith(b"#") else 0
    row = beginning[start:].partition(b"\n")[0].split()
    try:
        numbers = [float(value) for value in row]
    except ValueError as error:
        raise InvalidResponseError(f"the answer is no XYZ: {error}") from error
    if 0 < len(numbers) < 3:
        raise InvalidResponseError(f"the answer is no XYZ: a row has {len(numbers)} numbers")
    return _count_lines(file, start)


def _count_lines(file: BinaryIO, start: int) -> int:
    file.seek(start)
    count, last = 0, b"\n"
    for chunk in _chunks(file):
        count += chunk.count(b"\n")
        last = chunk[-1:]
    return count + (last != b"\n")


def _count_json(file: BinaryIO, beginning: bytes) -> int:
    """Count the rows of ``points`` by their brackets.

    ``points`` comes first, and neither it nor the object before it has a string with a bracket.
    """
    if not beginning.lstrip().startswith(b"{") or b'"points"' not in beginning[:64]:
        raise InvalidResponseError("the answer is no JSON object of points")
    file.seek(0)
    rows, depth, last = 0, 0, b""
    counting = True
    for chunk in _chunks(file):
        last = chunk.rstrip()[-1:] or last
        if not counting:
            continue
        letters = np.frombuffer(chunk, dtype=np.uint8)
        opens, closes = np.isin(letters, (0x5B, 0x7B)), np.isin(letters, (0x5D, 0x7D))
        steps = opens.astype(np.int8) - closes
        places = np.flatnonzero(steps)
        depths = depth + np.cumsum(steps[places])
        # The array of points ends with the first step from depth 2 to depth 1.
        ends = np.flatnonzero((depths == 1) & (steps[places] < 0))
        if len(ends):
            depths, places, counting = depths[: ends[0]], places[: ends[0]], False
        rows += int(np.count_nonzero((depths == _ROWS_DEPTH) & (steps[places] > 0)))
        depth = int(depths[-1]) if len(depths) else depth
    if counting or last != b"}":
        raise InvalidResponseError("the answer is a JSON that is cut")
    return rows


def _chunks(file: BinaryIO) -> Iterator[bytes]:
    while chunk := file.read(_CHUNK):
        yield chunk


_COUNTERS: dict[str, Callable[[BinaryIO, bytes], int]] = {
    "ply": _count_ply,
    "ply-ascii": _count_ply,
    "npz": _count_npz,
    "npy": _count_npy,
    "xyz": _count_xyz,
    "json": _count_json,
}
