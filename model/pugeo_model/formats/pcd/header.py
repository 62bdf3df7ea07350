# SPDX-License-Identifier: Apache-2.0
"""The header of a PCD file (version 0.7 and its predecessors)."""

import re
from dataclasses import dataclass
from typing import IO

import numpy as np

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Limits

__all__ = ["Field", "Header", "read_header", "sniff"]

_KINDS = {"I": "i", "U": "u", "F": "f"}
_WIDTHS = {"i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (2, 4, 8)}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_MOST_VALUES = 4096  # of one point, all fields together
_ENTRY = re.compile(rb"[ \t]*(#[^\r\n]*|[A-Z]+(?:[ \t][^\r\n]*)?)?[ \t]*(\r\n|\n|\r)")


@dataclass(frozen=True)
class Field:
    """One field: ``count`` values of a numpy type (without byte order) for each point."""

    name: str
    type: str
    count: int

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return np.dtype(self.type).itemsize * self.count


@dataclass(frozen=True)
class Header:
    """A parsed header; the file stands at the first byte after it.

    Attributes:
        fields: in the file's order; padding (``_``) included.
        points: number of points.
        organised: whether the points are the pixels of an image of two or more rows.
        viewpoint: sensor position.
        encoding: ``ascii``, ``binary`` or ``binary_compressed``.
        lines: lines of the header.
    """

    fields: tuple[Field, ...]
    points: int
    organised: bool
    viewpoint: tuple[float, float, float]
    encoding: str
    lines: int

    @property
    def row_bytes(self) -> int:
        """Bytes of a point in a binary file."""
        return sum(field.size for field in self.fields)


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a PCD file."""
    return re.match(rb"(?:[ \t]*#[^\n]*\n|\s)*(VERSION[ \t]+\.?\d|FIELDS[ \t])", head) is not None


def read_header(file: IO[bytes], limits: Limits) -> Header:
    """Read and check a header.

    Args:
        file: seekable, at the first byte. Left at the first byte of the points.
        limits: ``max_header_bytes``, ``max_header_lines`` and ``max_points`` are checked.

    Raises:
        MalformedFileError: not a PCD header, or a line that makes no sense.
        LimitExceededError: too long a header, or too many points.
    """
    start = file.tell()
    head = file.read(limits.max_header_bytes)
    entries: dict[str, list[str]] = {}
    place = lines = 0
    while "DATA" not in entries:
        line = _ENTRY.match(head, place)
        if line is None:
            more = len(head) + len(file.read(1))
            limits.check("max_header_bytes", more, "Bytes of the PCD header")
            raise MalformedFileError("The PCD header has no line 'DATA'.", code="no_header")
        place, lines = line.end(), lines + 1
        limits.check("max_header_lines", lines, "Lines of the PCD header")
        if line[1] and not line[1].startswith(b"#"):
            key, *words = line[1].decode("latin-1").split()
            if key in entries:
                raise _bad(lines, f"{key!r} is declared twice")
            entries[key] = words
    file.seek(start + place)
    header = _parse(entries, lines)
    limits.check("max_points", header.points, "Points of the PCD file")
    return header


def _parse(entries: dict[str, list[str]], lines: int) -> Header:
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    width = len(names)
    sizes, counts = _whole(entries, "SIZE", width), _whole(entries, "COUNT", width, 1)
    kinds = entries.get("TYPE", [])
    if not names or len(kinds) != width:
        raise _bad(lines, "FIELDS, SIZE, TYPE and COUNT must name the same number of fields")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        code = _KINDS.get(kind)
        if code is None or size not in _WIDTHS[code]:
            raise _bad(
                lines, f"field {name[:40]!r} has the unknown type {kind[:8]} of {size} bytes"
            )
        fields.append(Field(name, f"{code}{size}", count))
    if sum(counts) > _MOST_VALUES:
        raise _bad(lines, f"a point has {sum(counts):,} values, at most {_MOST_VALUES:,} are read")
    known = [name for name in names if name != "_"]
    if len(set(known)) < len(known):
        raise _bad(lines, "a field is declared twice")
    (width,) = _whole(entries, "WIDTH", 1, 0)
    (height,) = _whole(entries, "HEIGHT", 1, 1)
    (points,) = _whole(entries, "POINTS", 1, width * height)
    if "WIDTH" in entries and points != width * height:
        raise _bad(lines, f"POINTS is {points:,}, but WIDTH x HEIGHT is {width * height:,}")
    encoding = " ".join(entries["DATA"])
    if encoding not in _ENCODINGS:
        raise _bad(lines, f"DATA must be one of {', '.join(_ENCODINGS)}, not {encoding[:40]!r}")
    return Header(tuple(fields), points, height > 1, _viewpoint(entries, lines), encoding, lines)


def _whole(
    entries: dict[str, list[str]], key: str, width: int, default: int | None = None
) -> list[int]:
    words = entries.get(key)
    if words is None and default is not None:
        return [default] * width
    if (
        words is None
        or len(words) != width
        or not all(re.fullmatch("[0-9]{1,18}", w) for w in words)
    ):
        raise MalformedFileError(
            f"PCD header: {key} must be {width} whole numbers.", code="bad_header"
        )
    return [int(word) for word in words]


def _viewpoint(entries: dict[str, list[str]], lines: int) -> tuple[float, float, float]:
    words = entries.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])
    try:
        x, y, z, *_turn = (float(word) for word in words)
    except ValueError:
        raise _bad(lines, "VIEWPOINT must be seven numbers") from None
    if not np.isfinite([x, y, z]).all():
        raise _bad(lines, "VIEWPOINT is not finite")
    return x, y, z


def _bad(line: int, problem: str) -> MalformedFileError:
    return MalformedFileError(
        f"PCD header, up to line {line}: {problem}.", code="bad_header", line=line
    )
