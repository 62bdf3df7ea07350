# SPDX-License-Identifier: Apache-2.0
"""Binary PLY rows: a strided copy where all rows are alike, a compiled walk where they are not."""

import os
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.ply.header import Element
from pugeo_model.formats.ply.walk import find_segments, row_layout
from pugeo_model.formats.stream import CHUNK_BYTES, bytes_left

__all__ = ["read_rows"]

Sinks = Mapping[str, NDArray[Any]]


def read_rows(file: IO[bytes], element: Element, order: str, sinks: Sinks) -> None:
    """Read the rows of one element into ``sinks`` and leave the file after them.

    Args:
        file: at the first byte of the element.
        element: the properties of a row, and the number of rows.
        order: ``"<"`` or ``">"``.
        sinks: property name -> ``(element.count,)`` array. Empty: the rows are passed over.

    Raises:
        MalformedFileError: the file ends before the last row, or a list has a negative length.
    """
    if not element.has_lists:
        stride = element.least_row_bytes
        if sinks:
            _check_size(file, element, stride)
            _read_alike(file, element, _row_type(element, order, {}), sinks, {})
        else:
            _check_size(file, element, stride)
            file.seek(element.count * stride, os.SEEK_CUR)
    elif element.count:
        start = file.tell()
        lengths = _first_lengths(file, element, order)
        file.seek(start)
        done = 0
        if sum(lengths.values()) < CHUNK_BYTES:
            row_type = _row_type(element, order, lengths)
            done = _read_alike(file, element, row_type, sinks, lengths)
        if done < element.count:
            _read_walking(file, element, order, sinks, done, start)


def _row_type(element: Element, order: str, lengths: Mapping[str, int]) -> np.dtype[np.void]:
    """Describe a row whose lists have the given lengths (``"name#"`` is the length itself)."""
    fields: list[Any] = []
    for each in element.properties:
        if each.count_type is None:
            fields.append((each.name, order + each.type))
        else:
            fields.append((f"{each.name} #", order + each.count_type))
            fields.append((each.name, order + each.type, (lengths[each.name],)))
    return np.dtype(fields)


def _check_size(file: IO[bytes], element: Element, stride: int) -> None:
    expected, found = element.count * stride, bytes_left(file)
    if found < expected:
        raise truncated(element, expected, found, found // stride)


def truncated(element: Element, expected: int, found: int, rows: int) -> MalformedFileError:
    """Build the error about missing bytes or rows of an element."""
    return MalformedFileError(
        f"The file ends too early: {element.count:,} rows of {element.name!r} take at least "
        f"{expected:,} bytes, found {found:,} bytes ({rows:,} complete rows).",
        code="truncated",
        expected_bytes=expected,
        found_bytes=found,
        expected_rows=element.count,
        found_rows=rows,
    )


def _read_alike(
    file: IO[bytes],
    element: Element,
    row_type: np.dtype[np.void],
    sinks: Sinks,
    lengths: Mapping[str, int],
) -> int:
    """Read rows of one size; returns how many, up to the first one whose lists differ."""
    stride = row_type.itemsize
    step = max(1, CHUNK_BYTES // stride)
    done = 0
    while done < element.count:
        want = min(step, element.count - done)
        data = file.read(want * stride)
        rows = np.frombuffer(data, row_type, count=len(data) // stride)
        alike = len(rows)
        for name, length in lengths.items():
            differ = np.flatnonzero(rows[f"{name} #"][:alike] != length)
            alike = int(differ[0]) if len(differ) else alike
        _fill(sinks, done, rows[:alike])
        done += alike
        if alike < want:
            file.seek(alike * stride - len(data), os.SEEK_CUR)
            break
    return done


def _fill(sinks: Sinks, start: int, rows: NDArray[np.void]) -> None:
    # A double normal beyond float32 becomes infinite: cleaning deals with it, no warning needed.
    with np.errstate(over="ignore", invalid="ignore"):
        for name, sink in sinks.items():
            sink[start : start + len(rows)] = rows[name]


def _first_lengths(file: IO[bytes], element: Element, order: str) -> dict[str, int]:
    """Read the list lengths of the row at the file's position; moves the file."""
    lengths: dict[str, int] = {}
    found = bytes_left(file)
    for each in element.properties:
        if each.count_type is None:
            file.seek(each.least_bytes, os.SEEK_CUR)
            continue
        data = file.read(each.least_bytes)
        if len(data) < each.least_bytes:
            expected = element.count * element.least_row_bytes
            raise truncated(element, expected, found, 0)
        length = int(np.frombuffer(data, order + each.count_type)[0])
        skipped = length * np.dtype(each.type).itemsize
        if length < 0 or skipped > bytes_left(file):
            raise _bad_list(element, 0)
        lengths[each.name] = length
        file.seek(skipped, os.SEEK_CUR)
    return lengths


def _bad_list(element: Element, row: int) -> MalformedFileError:
    return MalformedFileError(
        f"Row {row:,} of {element.name!r} (from 0): a list has a negative length, or is longer "
        "than the rest of the file.",
        code="bad_list",
        row=row,
    )


def _read_walking(
    file: IO[bytes], element: Element, order: str, sinks: Sinks, done: int, start: int
) -> None:
    """Read rows of different sizes, from row ``done`` on; the first row began at ``start``."""
    layout = row_layout(element, order)
    data = b""
    while done < element.count:
        fresh = file.read(max(CHUNK_BYTES, len(data)))
        data += fresh
        step = min(element.count - done, len(data) // element.least_row_bytes, CHUNK_BYTES)
        offsets, used, broken = find_segments(
            np.frombuffer(data, np.uint8), step, layout, order == ">"
        )
        if broken:
            raise _bad_list(element, done + len(offsets))
        if len(offsets) == 0 and not fresh:
            found = file.tell() - start
            missing = (element.count - done) * element.least_row_bytes
            least = max(found - len(data) + missing, found + 1)
            raise truncated(element, least, found, done)
        for name, sink in sinks.items():
            segment, shift, kind = layout.fields[name]
            places = (offsets[:, segment] + shift)[:, None] + np.arange(kind.itemsize)
            values = np.frombuffer(data, np.uint8)[places].view(kind)[:, 0]
            with np.errstate(over="ignore", invalid="ignore"):
                sink[done : done + len(offsets)] = values
        done += len(offsets)
        data = data[used:]
    file.seek(-len(data), os.SEEK_CUR)
