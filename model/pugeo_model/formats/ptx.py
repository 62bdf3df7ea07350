# SPDX-License-Identifier: Apache-2.0
"""PTX, Leica's text format: scans as grids of points, each with the pose of its scanner."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.colors import to_channels, to_uint8
from pugeo_model.formats.limits import Limits
from pugeo_model.formats.numbers import NumberLines

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "drops", "read", "sniff", "write"]

NAME = "ptx"
EXTENSIONS: tuple[str, ...] = (".ptx",)
MEDIA_TYPES: tuple[str, ...] = ("application/x-ptx",)

_HEADER_WIDTHS = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
_WIDTHS = (3, 4, 6, 7)
_MOST_SCANS = 10_000
_BLOCK_ROWS = 16_384
_NUMBER = rb"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def _header_pattern() -> "re.Pattern[bytes]":
    lines = [rb"\s*\d+", rb"[ \t]*\d+"]
    lines += [rb"[ \t]*" + rb"[ \t]+".join([_NUMBER] * width) for width in _HEADER_WIDTHS[2:]]
    return re.compile(rb"[ \t]*(?:\r\n?|\n)".join(lines))


_HEADER = _header_pattern()


@dataclass(frozen=True)
class _Scan:
    """One scan: its finite points in the world, and its scanner.

    Attributes:
        points: ``(n, 3)`` float64.
        rest: ``(n, K - 3)`` float64: intensity, red, green, blue as far as there are any.
        position: ``(3,)`` scanner position in the world.
        empty: number of cells of the grid without a return.
    """

    points: NDArray[np.float64]
    rest: NDArray[np.float64]
    position: NDArray[np.float64]
    empty: int


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a PTX file."""
    return _HEADER.match(head) is not None


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read all scans of a PTX file, in the frame that their matrices lead to.

    A scan is columns, rows, scanner position, three axes, a 4x4 matrix ``T`` for row vectors, and
    one line for each cell of the grid: x y z, intensity (0..1), and colours where there are any.
    A point in the world is ``(x y z 1) T``. Cells without a return have x y z of zero and are left
    out. The scanner is where its origin leads to; it is the viewpoint of its points, and the
    scalar ``scan`` (from 0) tells scans apart where there are several.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the cells of all scans together.

    Raises:
        MalformedFileError: a broken header or row (with its line), or fewer rows than declared.
        LimitExceededError: more cells than ``limits``.
    """
    lines = NumberLines(file)
    scans: list[_Scan] = []
    cells = 0
    while lines and len(scans) < _MOST_SCANS:
        scan, count = _read_scan(lines, limits, cells)
        cells += count
        scans.append(scan)
    if not scans:
        raise MalformedFileError("The PTX file has no scan.", code="no_header")
    return _cloud(scans, cut_off=bool(lines))


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write one scan for each viewpoint, as a grid of one row; normals have no room.

    Points stay in the frame of the cloud, so that the matrix only holds the scanner's position.
    """
    if cloud.viewpoints is None or len(cloud.viewpoints) < 2 or "scan" not in cloud.scalars:
        position = np.zeros(3) if cloud.viewpoints is None else cloud.viewpoints[0]
        _write_scan(cloud, position, file)
        return
    for number, position in enumerate(cloud.viewpoints):
        _write_scan(cloud.take(cloud.scalars["scan"] == number), position, file)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    found = [name for name in cloud.scalars if name not in ("intensity", "scan")]
    if cloud.normals is not None:
        found.insert(0, "normals")
    if cloud.colors is not None and cloud.colors.shape[1] == 4:
        found.append("alpha")
    if cloud.colors is not None and cloud.colors.dtype == np.uint16:
        found.append("the lower 8 of 16 bits of colours")
    return found


def _read_scan(lines: NumberLines, limits: Limits, before: int) -> tuple[_Scan, int]:
    """Read one scan; returns the number of its cells too."""
    header = [_line(lines, width) for width in _HEADER_WIDTHS]
    width, height = (float(header[index][0]) for index in (0, 1))
    if not (width.is_integer() and height.is_integer() and width >= 0 and height >= 0):
        raise MalformedFileError(
            f"A PTX scan has {width:g} columns and {height:g} rows.", code="bad_header"
        )
    count = int(width) * int(height)
    limits.check("max_points", before + count, "Cells of the PTX scans")
    matrix = np.stack(header[6:10])
    if not np.isfinite(matrix).all():
        raise MalformedFileError("The matrix of a PTX scan is not finite.", code="bad_header")
    blocks: list[NDArray[np.float64]] = []
    found = columns = 0
    while found < count:
        rows = lines.take(count - found)
        if rows is None:
            raise MalformedFileError(
                f"A PTX scan declares {count:,} cells, found {found:,}.",
                code="truncated",
                expected_rows=count,
                found_rows=found,
            )
        lengths = np.diff(rows.starts)
        columns = columns or int(lengths[0])
        wrong = np.flatnonzero((lengths != columns) | ~np.isin(lengths, _WIDTHS))
        if len(wrong):
            line = int(rows.lines[wrong[0]])
            raise MalformedFileError(
                f"Line {line} has {lengths[wrong[0]]} numbers, a PTX row has "
                f"{' or '.join(map(str, _WIDTHS))}, all rows the same.",
                code="bad_row",
                line=line,
            )
        blocks.append(rows.values.reshape(-1, columns))
        found += len(rows)
    table = np.concatenate(blocks) if blocks else np.empty((0, 4))
    filled = table[:, :3].any(axis=1)
    kept = table[filled]
    with np.errstate(over="ignore", invalid="ignore"):
        points = kept[:, :3] @ matrix[:3, :3] + matrix[3, :3]
    return _Scan(points, kept[:, 3:], matrix[3, :3], count - len(kept)), count


def _line(lines: NumberLines, width: int) -> NDArray[np.float64]:
    rows = lines.take(1)
    if rows is None or len(rows.values) != width:
        where = "at the end" if rows is None else f"in line {rows.lines[0]}"
        raise MalformedFileError(
            f"The header of a PTX scan is broken {where}: expected {width} numbers.",
            code="bad_header",
        )
    return rows.values


def _cloud(scans: list[_Scan], *, cut_off: bool) -> Cloud:
    notes: list[str] = []
    empty = sum(scan.empty for scan in scans)
    if empty:
        notes.append(f"{empty:,} empty cells of the grid are left out.")
    if cut_off:
        notes.append(f"Scans after the first {_MOST_SCANS:,} are ignored.")
    columns = min(scan.rest.shape[1] for scan in scans)
    if any(scan.rest.shape[1] != columns for scan in scans):
        notes.append("Columns that only some of the scans have are dropped.")
        columns = {1: 1, 4: 4}.get(columns, 0)
    rest = [scan.rest[:, :columns] for scan in scans]
    table = np.concatenate(rest)
    scalars: dict[str, NDArray[Any]] = {}
    if columns in (1, 4):
        scalars["intensity"] = np.ascontiguousarray(table[:, 0])
    if len(scans) > 1:
        sizes = [len(scan.points) for scan in scans]
        scalars["scan"] = np.repeat(np.arange(len(scans), dtype=np.uint16), sizes)
    colors = None
    if columns >= 3:
        colors, note = to_channels(_whole(table[:, -3:]))
        notes += [note] if note else []
    return Cloud(
        np.concatenate([scan.points for scan in scans]),
        colors=colors,
        scalars=scalars,
        notes=tuple(notes),
        viewpoints=np.stack([scan.position for scan in scans]),
        source=SourceInfo("ptx"),
    )


def _whole(values: NDArray[np.float64]) -> NDArray[Any]:
    """Colours as integers where they are whole, since 1 of 255 is not 1.0."""
    with np.errstate(invalid="ignore"):
        whole = (values >= 0) & (values <= 65535) & (values == np.rint(values))
    return values.astype(np.int32) if whole.all() else values


def _write_scan(cloud: Cloud, position: NDArray[np.float64], file: IO[bytes]) -> None:
    place = " ".join(f"{value:.17g}" for value in position)
    file.write(f"{len(cloud)}\n1\n{place}\n1 0 0\n0 1 0\n0 0 1\n".encode())
    file.write(f"1 0 0 0\n0 1 0 0\n0 0 1 0\n{place} 1\n".encode())
    for block in _rows(cloud, position):
        file.write(block)


def _rows(cloud: Cloud, position: NDArray[np.float64]) -> Iterator[bytes]:
    digits = "%.9g" if cloud.points.dtype == np.float32 and not position.any() else "%.17g"
    intensity = cloud.scalars.get("intensity", np.full(len(cloud), 0.5))
    colors = None if cloud.colors is None else to_uint8(cloud.colors[:, :3])[0]
    finest = "%.17g" if intensity.dtype == np.float64 else "%.9g"
    line = (
        " ".join([digits] * 3) + f" {finest}" + (" %d %d %d" if colors is not None else "") + "\n"
    )
    for start in range(0, len(cloud), _BLOCK_ROWS):
        part = slice(start, start + _BLOCK_ROWS)
        points = cloud.points[part].astype(np.float64) - position
        cells = np.empty((len(points), 7 if colors is not None else 4), object)
        cells[:, :3], cells[:, 3] = points, intensity[part]
        if colors is not None:
            cells[:, 4:] = colors[part]
        yield (line * len(points) % tuple(cells.ravel().tolist())).encode()
