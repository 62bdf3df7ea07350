# SPDX-License-Identifier: Apache-2.0
"""Points as text: XYZ, PTS, CSV and their kin, one point a line."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.colors import to_uint8
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.numbers import NumberLines, Rows
from pugeo_model.formats.ply.columns import VertexColumns
from pugeo_model.formats.ply.encode import RESERVED, body, columns
from pugeo_model.formats.ply.header import Element, Property

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "head", "read", "rows", "sniff", "write"]

NAME = "xyz"
EXTENSIONS: tuple[str, ...] = (".xyz", ".pts", ".txt", ".csv", ".asc")
MEDIA_TYPES: tuple[str, ...] = ("text/plain", "text/csv")

_HEAD_BYTES = 65_536
_MAX_COLUMNS = 256
_TABLE = bytes.maketrans(b",;", b"  ")
_TABLE_MAC = bytes.maketrans(b",;\r", b"  \n")
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_COMMENT = re.compile(rb"(?:#|//).*")
_NAMES = re.compile(
    rb"\s*(#|//)?[ \t]*(x[ \t,;]+y[ \t,;]+z\b[^\r\n]*)(?:\r\n?|\n|$)", re.IGNORECASE
)
_UNIT = 1e-2


def sniff(head: bytes) -> bool:
    """Whether the first lines are numbers, three or more, with a count or names before them."""
    if _NAMES.match(head):
        return True
    lines = _first_lines(head)
    if lines and len(lines[0]) == 1:
        lines = lines[1:]
    if not lines or len(lines[0]) < 3:
        return False
    return all(_NUMBER.fullmatch(token) for token in lines[0])


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read lines of numbers, separated by blanks, commas or semicolons.

    A first line with a single number is a count (PTS). ``#`` and ``//`` begin a comment. A first
    line, comment or not, that begins with ``x y z`` names the columns, as in PLY. Otherwise what
    the columns after x, y, z mean is guessed from their values, and the guess is noted:

    - 6 columns: normals if all have unit length; else red, green, blue if all are whole numbers
      in 0..255; else scalars ``c3``, ``c4``, ``c5``.
    - 7 columns with whole numbers in 0..255 in the last three: intensity, red, green, blue.
    - else scalars, labels where all values are whole numbers.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the rows.

    Raises:
        MalformedFileError: something is no number (with its line), rows of different lengths, fewer
            rows than the count says, decimal commas.
        LimitExceededError: more points than ``limits``.
    """
    start = file.tell()
    head = file.read(_HEAD_BYTES)
    _refuse_decimal_commas(head)
    names, passed = _names(head)
    file.seek(start + passed)
    first = _first_lines(head[passed:])
    bare = b"\r" in head and b"\n" not in head
    lines = NumberLines(
        file,
        line=1 + head.count(b"\r" if bare else b"\n", 0, passed),
        translate=_TABLE_MAC if bare else _TABLE,
        comments=True,
    )
    declared: int | None = None
    if first and len(first[0]) == 1 and (row := lines.take(1)) is not None:
        declared = _count(row, limits)
    table = _table(lines, declared, limits)
    cloud = _guess(table, declared is not None) if names is None else _by_name(table, names)
    if declared is None or not lines:
        return cloud
    note = f"Rows after the {declared:,} that the first line counts are ignored."
    return replace(cloud, notes=(*cloud.notes, note))


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write x y z, then normals, colours and scalars where there are any, named in a comment."""
    file.write(head(cloud, len(cloud)))
    for block in rows(cloud):
        file.write(block)


def head(cloud: Cloud, count: int) -> bytes:
    """What comes before the rows of ``count`` points like those of the cloud."""
    del count  # the format does not say it
    names = [each.name for each in columns(cloud)]
    return f"# {' '.join(names)}\n".encode() if len(names) > 3 else b""


def rows(cloud: Cloud) -> Iterator[bytes]:
    """The rows of some of the points."""
    return body(cloud, text=True)


def _first_lines(head: bytes) -> list[list[bytes]]:
    """Split the first two lines that hold anything into tokens."""
    found: list[list[bytes]] = []
    for line in re.split(rb"[\r\n]+", head):
        tokens = _COMMENT.sub(b"", line.translate(_TABLE)).split()
        if tokens:
            found.append(tokens)
            if len(found) == 2:
                break
    return found


def _names(head: bytes) -> tuple[list[str] | None, int]:
    """Find the names in a first line ``x y z ...``, and where the line after it begins."""
    line = _NAMES.match(head)
    if line is None:
        return None, 0
    names = line[2].translate(_TABLE).decode("utf-8", "replace").split()
    # Capitals mean nothing in the names that PLY fixes; elsewhere they are kept.
    names = [name.lower() if name.lower() in RESERVED else name for name in names]
    rows = _first_lines(head[line.end() :])
    fits = len(set(names)) == len(names) and (not rows or len(rows[-1]) == len(names))
    if line[1] and not fits:
        # A comment such as "# x y z in metres".
        return None, 0
    if not fits:
        raise MalformedFileError(
            f"The first line names {len(names)} columns, one of them twice, or the rows have "
            "another number of them.",
            code="bad_header",
        )
    return names, line.end()


def _refuse_decimal_commas(head: bytes) -> None:
    """Refuse ``1,5 2,5 3,5`` and ``1,5;2,5;3,5``, which would read as six columns."""
    for line in re.split(rb"[\r\n]+", head)[:2]:
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


def _table(lines: NumberLines, declared: int | None, limits: Limits) -> NDArray[np.float64]:
    """Read all rows, or as many as declared, as ``(M, K)``."""
    blocks: list[NDArray[np.float64]] = []
    width = found = 0
    while declared is None or found < declared:
        rows = lines.take(limits.max_points + 1 if declared is None else declared - found)
        if rows is None:
            break
        lengths = np.diff(rows.starts)
        width = width or int(lengths[0])
        wrong = np.flatnonzero(lengths != width)
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
        blocks.append(rows.values.reshape(-1, width))
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
    kinds = ["i8" if _are_whole(values) else "f8" for values in table.T]
    properties = tuple(Property(n, k) for n, k in zip(names, kinds, strict=True))
    vertices = VertexColumns(Element("vertex", len(table), properties))
    # What float32 cannot hold becomes infinite: cleaning deals with it, no warning needed.
    with np.errstate(over="ignore", invalid="ignore"):
        for name, values in zip(names, table.T, strict=True):
            if name in vertices.sinks:
                vertices.sinks[name][:] = values
    return vertices.cloud()


def _guess(table: NDArray[np.float64], counted: bool) -> Cloud:
    points = np.ascontiguousarray(table[:, :3])
    width = table.shape[1]
    if width == 6 and _are_unit(table[:, 3:]):
        note = "Columns 4 to 6 have unit length and were read as normals."
        return Cloud(points, table[:, 3:].astype(np.float32), notes=(note,))
    colors: NDArray[np.uint8] | None = None
    notes: list[str] = []
    extras = list(range(3, width))
    if width in (6, 7) and _are_bytes(table[:, -3:]):
        colors, _ = to_uint8(table[:, -3:].astype(np.uint8))
        notes.append(f"Columns {width - 2} to {width} were read as red, green, blue.")
        extras = extras[:-3]
    scalars: dict[str, NDArray[Any]] = {}
    for column in extras:
        values = np.ascontiguousarray(table[:, column])
        name = "intensity" if colors is not None or (counted and width == 4) else f"c{column}"
        if name != "intensity" and _are_whole(values):
            values = values.astype(np.int64)
        scalars[name] = values
    if scalars:
        notes.append(f"Unnamed columns were read as scalars: {', '.join(scalars)}.")
    return Cloud(points, None, colors, scalars, tuple(notes))


def _are_unit(rows: NDArray[np.float64]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return bool((np.abs(np.linalg.norm(rows, axis=1) - 1.0) <= _UNIT).all())


def _are_bytes(rows: NDArray[np.float64]) -> bool:
    return bool(((rows >= 0) & (rows <= 255) & (rows == np.rint(rows))).all())


def _are_whole(values: NDArray[np.float64]) -> bool:
    return bool(((np.abs(values) <= 2**53) & (values == np.rint(values))).all())
