# SPDX-License-Identifier: Apache-2.0
"""The header of a PLY file: elements, their properties and types, byte order."""

import re
from dataclasses import dataclass
from typing import IO, TypeVar

import numpy as np

from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Limits

__all__ = ["Element", "Header", "Property", "read_header"]

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_Value = TypeVar("_Value")
_MAGIC = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")


@dataclass(frozen=True)
class Property:
    """One value of an element, or a list of values preceded by its length.

    Attributes:
        name: as in the file.
        type: numpy code without byte order, such as ``"f4"``.
        count_type: the type of a list's length; ``None`` for a single value.
    """

    name: str
    type: str
    count_type: str | None = None

    @property
    def least_bytes(self) -> int:
        """Bytes in a binary file: exact for a value, those of an empty list for a list."""
        return np.dtype(self.count_type or self.type).itemsize


@dataclass(frozen=True)
class Element:
    """Rows of one kind: ``count`` times the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """True if rows may differ in size."""
        return any(each.count_type for each in self.properties)

    @property
    def least_row_bytes(self) -> int:
        """Bytes of a binary row whose lists are empty."""
        return sum(each.least_bytes for each in self.properties)


@dataclass(frozen=True)
class Header:
    """A parsed header; the file stands at the first byte after it.

    Attributes:
        order: ``"<"``, ``">"`` for a binary body, ``""`` for a text body.
        elements: in the file's order.
        lines: lines of the header, to number those of a text body.
        newline: the line ending, which old Macintosh files write as a bare carriage return.
    """

    order: str
    elements: tuple[Element, ...]
    lines: int
    newline: bytes


def read_header(file: IO[bytes], limits: Limits) -> Header:
    """Read and check a header, never more than ``limits.max_header_bytes`` of the file.

    Args:
        file: seekable, at the ``ply`` line. Left at the first byte of the body.
        limits: ``max_header_bytes``, ``max_header_lines`` and ``max_points`` are checked.

    Raises:
        MalformedFileError: not a PLY header, a line that cannot be parsed, a name declared twice.
        LimitExceededError: too long a header, or too many points.
    """
    start = file.tell()
    head = file.read(limits.max_header_bytes)
    magic = _MAGIC.match(head)
    if magic is None:
        raise MalformedFileError("The file does not begin with a line 'ply'.", code="no_header")
    newline = magic[1]
    ending = rb"\rend_header[ \t]*\r" if newline == b"\r" else rb"\nend_header[ \t]*\r?\n"
    end = re.search(ending, head)
    if end is None:
        # One byte more tells a header that is too long from one that just stops.
        more = file.read(1)
        limits.check("max_header_bytes", len(head) + len(more), "Bytes of the PLY header")
        raise MalformedFileError("The PLY header has no line 'end_header'.", code="no_header")
    file.seek(start + end.end())
    # Split at line ends only: str.splitlines would also split at characters inside a comment.
    lines = head[magic.end() : end.start()].split(b"\r" if newline == b"\r" else b"\n")
    limits.check("max_header_lines", len(lines) + 2, "Lines of the PLY header")
    order, elements = _parse([_decode(line).split() for line in lines])
    for element in elements:
        if element.name == "vertex":
            limits.check("max_points", element.count, "Points of the PLY file")
    return Header(order, elements, len(lines) + 2, newline)


def _decode(line: bytes) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _parse(lines: list[list[str]]) -> tuple[str, tuple[Element, ...]]:
    order: str | None = None
    elements: dict[str, tuple[int, dict[str, Property]]] = {}
    properties: dict[str, Property] | None = None
    for number, words in enumerate(lines, start=2):
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", encoding, _] if order is None and encoding in _ORDERS:
                order = _ORDERS[encoding]
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                properties = _add(elements, name, (int(count), {}), number)[1]
            case ["property", *rest] if properties is not None and (new := _property(rest)):
                _add(properties, new.name, new, number)
            case _:
                raise _bad_line(number, f"cannot understand {' '.join(words)[:80]!r}")
    if order is None:
        raise MalformedFileError("The PLY header has no line 'format'.", code="bad_header")
    return order, tuple(
        Element(name, count, tuple(each.values())) for name, (count, each) in elements.items()
    )


def _add(known: dict[str, _Value], name: str, new: _Value, number: int) -> _Value:
    if name in known:
        raise _bad_line(number, f"{name!r} is declared twice")
    known[name] = new
    return new


def _property(words: list[str]) -> Property | None:
    match words:
        case ["list", count_type, item_type, name]:
            # The length of a list cannot be a fraction.
            if _TYPES.get(count_type, "f")[0] != "f" and item_type in _TYPES:
                return Property(name, _TYPES[item_type], _TYPES[count_type])
        case [kind, name] if kind in _TYPES:
            return Property(name, _TYPES[kind])
    return None


def _bad_line(number: int, what: str) -> MalformedFileError:
    return MalformedFileError(f"PLY header, line {number}: {what}.", code="bad_header", line=number)
