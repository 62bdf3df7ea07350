# SPDX-License-Identifier: Apache-2.0
"""The points of a PCD file in its three encodings, as one array for each field."""

import struct
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats import lzf
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.numbers import NumberLines
from pugeo_model.formats.pcd.header import Field, Header
from pugeo_model.formats.stream import CHUNK_BYTES, bytes_left

__all__ = ["read_columns"]

Columns = dict[str, NDArray[Any]]
"""Field name -> ``(points,)``, or ``(points, count)`` for a field of several values."""


def read_columns(file: IO[bytes], header: Header, limits: Limits) -> Columns:
    """Read all fields but padding.

    Args:
        file: at the first byte of the points.
        header: describes them.
        limits: ``max_bytes`` bounds the size that compressed points unpack to.

    Raises:
        MalformedFileError: fewer bytes or values than the header declares.
        LimitExceededError: compressed points that unpack to more than ``max_bytes``.
    """
    if header.encoding == "ascii":
        return _ascii(file, header)
    if header.encoding == "binary":
        return _binary(file, header)
    return _compressed(file, header, limits)


def _empty(header: Header) -> Columns:
    shape = {1: (header.points,)}
    return {
        field.name: np.empty(shape.get(field.count, (header.points, field.count)), field.type)
        for field in _wanted(header)
    }


def _wanted(header: Header) -> list[Field]:
    return [field for field in header.fields if field.name != "_" and field.count > 0]


def _binary(file: IO[bytes], header: Header) -> Columns:
    stride = header.row_bytes
    _check_size(header.points * stride, bytes_left(file), header, stride)
    columns = _empty(header)
    kind = np.dtype(
        {
            "names": [field.name for field in _wanted(header)],
            "formats": [
                (f"<{f.type}", (f.count,)) if f.count > 1 else f"<{f.type}" for f in _wanted(header)
            ],
            "offsets": [_offset(header, field) for field in _wanted(header)],
            "itemsize": stride,
        }
    )
    step = max(1, CHUNK_BYTES // max(1, stride))
    for start in range(0, header.points, step):
        stop = min(start + step, header.points)
        rows = np.frombuffer(file.read((stop - start) * stride), kind)
        for name, values in columns.items():
            values[start:stop] = rows[name]
    return columns


def _offset(header: Header, wanted: Field) -> int:
    place = 0
    for field in header.fields:
        if field is wanted:
            break
        place += field.size
    return place


def _compressed(file: IO[bytes], header: Header, limits: Limits) -> Columns:
    """Points compressed by LZF, field after field instead of point after point."""
    sizes = file.read(8)
    if len(sizes) < 8:
        raise _truncated(header, 8, len(sizes), 0)
    packed, unpacked = struct.unpack("<II", sizes)
    expected = header.points * header.row_bytes
    if unpacked != expected:
        raise MalformedFileError(
            f"The compressed points unpack to {unpacked:,} bytes, but the header declares "
            f"{expected:,}.",
            code="truncated",
        )
    limits.check("max_bytes", unpacked, "Bytes that the PCD file unpacks to")
    _check_size(packed, bytes_left(file), header, 0)
    data = lzf.decompress(file.read(packed), unpacked)
    if data is None:
        raise MalformedFileError("The compressed points cannot be unpacked.", code="bad_row")
    columns: Columns = {}
    place = 0
    for field in header.fields:
        end = place + header.points * field.size
        if field.name != "_" and field.count > 0:
            values = data[place:end].view(f"<{field.type}").astype(field.type)
            columns[field.name] = values.reshape(-1, field.count) if field.count > 1 else values
        place = end
    return columns


def _ascii(file: IO[bytes], header: Header) -> Columns:
    width = sum(field.count for field in header.fields)
    # A value takes a digit and a blank; the very last line may lack its end.
    _check_size(2 * width * header.points - 1, bytes_left(file), header, 2 * width)
    columns = _empty(header)
    lines = NumberLines(file, line=header.lines + 1)
    done = 0
    while done < header.points:
        rows = lines.take(header.points - done)
        if rows is None:
            raise _truncated(header, header.points, done, done)
        wrong = np.flatnonzero(np.diff(rows.starts) != width)
        if len(wrong):
            line = int(rows.lines[wrong[0]])
            raise MalformedFileError(
                f"Line {line} has not the {width} values of a point.", code="bad_row", line=line
            )
        table = rows.values.reshape(-1, width)
        place = 0
        for field in header.fields:
            values = table[:, place : place + field.count]
            if field.name in columns:
                _fill(columns[field.name][done : done + len(table)], values, field, rows.lines)
            place += field.count
        done += len(table)
    return columns


def _fill(
    target: NDArray[Any], values: NDArray[np.float64], field: Field, lines: NDArray[np.int64]
) -> None:
    if field.type[0] != "f":
        bounds = np.iinfo(field.type)
        low, high = max(bounds.min, -(2**53)), min(bounds.max, 2**53)
        good = (values >= low) & (values <= high) & (values == np.rint(values))
        if not good.all():
            line = int(lines[np.argmin(good.all(axis=1))])
            raise MalformedFileError(
                f"Line {line}: a value of {field.name[:40]!r} is no whole number in its range.",
                code="bad_row",
                line=line,
            )
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        target[:] = values if field.count > 1 else values[:, 0]


def _check_size(expected: int, found: int, header: Header, row: int) -> None:
    if found < expected:
        raise _truncated(header, expected, found, found // row if row else 0)


def _truncated(header: Header, expected: int, found: int, rows: int) -> MalformedFileError:
    return MalformedFileError(
        f"The file ends too early: {header.points:,} points need {expected:,}, found {found:,}.",
        code="truncated",
        expected_rows=header.points,
        found_rows=rows,
    )
