# SPDX-License-Identifier: Apache-2.0
"""Points as text: XYZ, PTS, CSV and similar, one point a line."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.meaning import are_whole, guess, standard_name
from pugeo_model.formats.numbers import NumberLines, Rows
from pugeo_model.formats.ply.columns import VertexColumns
from pugeo_model.formats.ply.encode import body, columns, rounded
from pugeo_model.formats.ply.header import Element, Property
from pugeo_model.formats.text_layout import Layout, as_utf8, find_layout, plain_head

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "drops", "head", "read", "rows", "sniff", "write"]

NAME = "xyz"
EXTENSIONS: tuple[str, ...] = (
    *(".xyz", ".pts", ".txt", ".csv", ".asc", ".xyzn", ".xyzrgb", ".neu", ".dat"),
)
MEDIA_TYPES: tuple[str, ...] = ("text/plain", "text/csv")

_HEAD_BYTES = 65_536
_MAX_COLUMNS = 256
_GROUPS = (frozenset(["red", "green", "blue", "alpha"]), frozenset(["nx", "ny", "nz"]))
_TABLE = bytes.maketrans(b',;"', b"   ")
_TABLE_MAC = bytes.maketrans(b',;"\r', b"   \n")


def sniff(head: bytes) -> bool:
    """True if the first lines are numbers, three or more, with a count or names before them."""
    try:
        return find_layout(plain_head(head)) is not None
    except MalformedFileError:
        return True


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read lines of numbers, separated by blanks, commas or semicolons.

    Lines before the first row may be comments (``#``, ``//``), a count of points (PTS), and names
    of the columns, as a comment or not, in any order and with or without quotes. Named columns
    mean the same as in PLY, in any case and with the usual other names (Easting, Rf, NormalX). The
    meaning of unnamed columns is guessed from their values, see `meaning.guess`. A blank cell is a
    missing value (NaN). UTF-8 and UTF-16 are read, with a byte order mark.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the rows.

    Raises:
        MalformedFileError: something is no number (with its line), rows of different lengths, fewer
            rows than the count says, decimal commas.
        LimitExceededError: more points than ``limits``.
    """
    with as_utf8(file, limits) as text:
        return _read(text, limits)


def _read(file: IO[bytes], limits: Limits) -> Cloud:
    start = file.tell()
    head = file.read(_HEAD_BYTES)
    _refuse_decimal_commas(head)
    text = head.decode("latin-1")
    layout = find_layout(text) or Layout(None, False, 0, 0, False, False, "," in text)
    file.seek(start + layout.passed)
    lines = NumberLines(
        file,
        line=1 + layout.lines,
        translate=_TABLE_MAC if layout.bare_returns else _TABLE,
        comments=True,
        blank_cells=layout.table,
    )
    declared: int | None = None
    if layout.counted and (row := lines.take(1)) is not None:
        declared = _count(row, limits)
    width = len(layout.names) if layout.names is not None and layout.ragged else None
    table = _table(lines, declared, limits, width)
    if layout.names is None:
        cloud = guess(table, counted=declared is not None)
    else:
        cloud = _by_name(table, layout.names)
    notes = list(cloud.notes)
    if layout.ragged:
        notes.append("The tracks of COLMAP's points are dropped.")
    if declared is not None and lines:
        notes.append(f"Rows after the {declared:,} that the first line counts are ignored.")
    return replace(cloud, notes=tuple(notes))


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write x y z, then normals, colours and scalars where there are any, named in a comment."""
    file.write(head(cloud, len(cloud)))
    for block in rows(cloud):
        file.write(block)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    return rounded(cloud)


def head(cloud: Cloud, count: int) -> bytes:
    """Bytes before the rows of ``count`` points with the attributes of ``cloud``."""
    del count  # the format does not say it
    names = [each.name for each in columns(cloud)]
    return f"# {' '.join(names)}\n".encode() if len(names) > 3 else b""


def rows(cloud: Cloud) -> Iterator[bytes]:
    """The rows of some of the points."""
    return body(cloud, text=True)


def _refuse_decimal_commas(head: bytes) -> None:
    """Refuse ``1,5 2,5 3,5`` and ``1,5;2,5;3,5``, which would read as six columns."""
    for line in re.split(rb"[\r\n]+", head)[:3]:
        if re.match(rb"\s*[+-]?\d+,\d+(\s*;|[ \t]+)[+-]?\d+,\d+\b", line):
            raise MalformedFileError(
                "Decimal commas are not read: write 1.5, not 1,5.", code="not_a_number"
            )


def _count(row: Rows, limits: Limits) -> int:
    value = float(row.values[0])
    if not value.is_integer() or value < 0:
        raise MalformedFileError(
            f"Line {row.lines[0]}: a single number must be a count of points, not {value:g}.",
            code="bad_row",
            line=int(row.lines[0]),
        )
    limits.check("max_points", int(value), "Points that the first line counts")
    return int(value)


def _table(
    lines: NumberLines, declared: int | None, limits: Limits, leading: int | None
) -> NDArray[np.float64]:
    """Read all rows, or as many as declared, as ``(M, K)``; only ``leading`` columns if given."""
    blocks: list[NDArray[np.float64]] = []
    width, found = leading or 0, 0
    while declared is None or found < declared:
        rows = lines.take(limits.max_points + 1 if declared is None else declared - found)
        if rows is None:
            break
        lengths = np.diff(rows.starts)
        width = width or int(lengths[0])
        wrong = np.flatnonzero(lengths != width if leading is None else lengths < width)
        if len(wrong) or not 3 <= width <= _MAX_COLUMNS:
            index = int(wrong[0]) if len(wrong) else 0
            line = int(rows.lines[index])
            raise MalformedFileError(
                f"Line {line} has {lengths[index]} numbers, expected "
                f"{width if len(wrong) else f'3 to {_MAX_COLUMNS}'}.",
                code="bad_row",
                line=line,
            )
        found += len(rows)
        limits.check("max_points", found, "Points of the file, at least")
        if leading is None:
            blocks.append(rows.values.reshape(-1, width))
        else:
            blocks.append(rows.values[rows.starts[:-1, None] + np.arange(width)])
    if declared is not None and found < declared:
        raise MalformedFileError(
            f"The first line counts {declared:,} points, found {found:,}.",
            code="truncated",
            expected_rows=declared,
            found_rows=found,
        )
    return np.concatenate(blocks) if blocks else np.empty((0, 3))


def _by_name(table: NDArray[np.float64], names: list[str]) -> Cloud:
    """Give columns the meaning that they would have in a PLY file."""
    if not len(table):
        table = np.empty((0, len(names)))
    plain, notes = _standard_names(names)
    used = [(name, values) for name, values in zip(plain, table.T, strict=True) if name]
    kinds = ["i8" if are_whole(values) else "f8" for _, values in used]
    for index, original in enumerate(n for n, kept in zip(names, plain, strict=True) if kept):
        # "Rf" promises 0..1, also where all values happen to be 0 and 1.
        if original.lower() in ("rf", "gf", "bf"):
            kinds[index] = "f8"
    properties = tuple(Property(n, k) for (n, _), k in zip(used, kinds, strict=True))
    vertices = VertexColumns(Element("vertex", len(table), properties), "text")
    # A value that float32 cannot hold becomes infinite: cleaning drops it, no warning needed.
    with np.errstate(over="ignore", invalid="ignore"):
        for name, values in used:
            if name in vertices.sinks:
                vertices.sinks[name][:] = values
    cloud = vertices.cloud()
    return replace(cloud, notes=(*cloud.notes, *notes))


def _standard_names(names: list[str]) -> tuple[list[str | None], list[str]]:
    """PLY names where columns have a standard meaning, ``None`` for an index, and notes."""
    found: list[str | None] = []
    notes: list[str] = []
    there = {standard_name(name) for name in names}
    for name in names:
        standard = standard_name(name)
        # "a" alone is no alpha, nor "r" alone red.
        group = next((group for group in _GROUPS if standard in group), frozenset())
        if not group - {"alpha"} <= there:
            standard = None
        if not name or name == "Unnamed: 0":
            found.append(None)
            notes.append("The column without a name (an index) is dropped.")
        elif standard is not None and standard not in found and standard not in names:
            found.append(standard)
        else:
            found.append(name)
    lowered = {name.lower() for name in names}
    if lowered & {"longitude", "lon", "lng", "long"}:
        notes.append(
            "x and y are longitude and latitude in degrees: project them to metres first, since "
            "distances between degrees and a height in metres mean nothing."
        )
    return found, notes
