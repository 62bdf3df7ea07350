# SPDX-License-Identifier: Apache-2.0
"""PLY, read in all its variants, written as binary little endian."""

import re
from collections.abc import Iterator
from typing import IO

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.limits import Declared, Limits
from pugeo_model.formats.numbers import NumberLines
from pugeo_model.formats.ply import binary, text
from pugeo_model.formats.ply.columns import VertexColumns
from pugeo_model.formats.ply.encode import body, encode, header, rounded, size
from pugeo_model.formats.ply.header import Element, Header, read_header
from pugeo_model.formats.stream import bytes_left

__all__ = [
    "EXTENSIONS",
    "MEDIA_TYPES",
    "NAME",
    "body",
    "declared",
    "drops",
    "encode",
    "head",
    "header",
    "read",
    "rows",
    "size",
    "sniff",
    "write",
]

NAME = "ply"
EXTENSIONS: tuple[str, ...] = (".ply",)
MEDIA_TYPES: tuple[str, ...] = ("application/ply", "application/x-ply", "model/ply")

_MAC_LINES = bytes.maketrans(b"\r", b"\n")


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a PLY file."""
    return re.match(rb"ply[ \t]*[\r\n]", head) is not None


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read the vertices of a PLY file.

    What is declared is compared with the bytes that are there before anything is allocated.
    Elements other than ``vertex`` are passed over.

    Args:
        file: seekable, at the first byte.
        limits: bounds of the header and of the number of points.

    Raises:
        MalformedFileError: not PLY, truncated, no points, a value that makes no sense.
        LimitExceededError: header or number of points above ``limits``.
    """
    parsed = read_header(file, limits)
    vertex = _vertices(parsed)
    _check_size(file, parsed)
    columns = VertexColumns(vertex)
    index = parsed.elements.index(vertex)
    if parsed.order:
        for element in parsed.elements[:index]:
            binary.read_rows(file, element, parsed.order, {})
        binary.read_rows(file, vertex, parsed.order, columns.sinks)
    else:
        table = _MAC_LINES if parsed.newline == b"\r" else None
        lines = NumberLines(file, line=parsed.lines + 1, translate=table)
        for element in parsed.elements[:index]:
            text.read_rows(lines, element, {})
        text.read_rows(lines, vertex, columns.sinks)
        if index == len(parsed.elements) - 1 and lines:
            columns.notes.append("Text after the last row is ignored.")
    if parsed.order and not any(each.has_lists for each in parsed.elements[index + 1 :]):
        rest = sum(each.count * each.least_row_bytes for each in parsed.elements[index + 1 :])
        if extra := bytes_left(file) - rest:
            columns.notes.append(f"{extra:,} bytes after the last row are ignored.")
    faces = sum(each.count for each in parsed.elements if each.name in ("face", "tristrips"))
    if faces:
        columns.notes.append(
            f"The file is a mesh: its {faces:,} faces are dropped, and its corners alone are "
            "taken as the scan."
        )
    return columns.cloud()


def declared(file: IO[bytes], limits: Limits) -> Declared:
    """Return the size of a cloud as the header states it.

    Args:
        file: seekable, at the first byte.
        limits: bounds of the header and of the number of points.

    Raises:
        MalformedFileError, LimitExceededError: as `read`.
    """
    vertex = _vertices(read_header(file, limits))
    return Declared(vertex.count, vertex.least_row_bytes)


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write binary little endian: points in their own precision, scalars in their own types."""
    for block in encode(cloud):
        file.write(block)


def drops(cloud: Cloud) -> list[str]:
    """Name the attributes that the format has no room for."""
    return rounded(cloud)


def head(cloud: Cloud, count: int) -> bytes:
    """Bytes before the rows of ``count`` points with the attributes of ``cloud``."""
    return header(cloud, count=count)


def rows(cloud: Cloud) -> Iterator[bytes]:
    """The rows of some of the points."""
    return body(cloud)


def _vertices(parsed: Header) -> Element:
    vertex = next((each for each in parsed.elements if each.name == "vertex"), None)
    if vertex is None:
        raise MalformedFileError("The PLY file has no element 'vertex'.", code="missing_property")
    return vertex


def _check_size(file: IO[bytes], parsed: Header) -> None:
    """Compare the least size that the header promises with the size there is."""
    found = bytes_left(file)
    least = 0
    for element in parsed.elements:
        # In text, a value takes a digit and a blank; the very last line may lack its end.
        row = element.least_row_bytes if parsed.order else 2 * len(element.properties)
        before, least = least, least + element.count * row
        if least - (not parsed.order) > found:
            raise binary.truncated(element, least, found, max(0, found - before) // row)
