# SPDX-License-Identifier: Apache-2.0
"""Reader of the PLY that the service writes: one element, scalar vertex properties only.

The model package has a reader for PLY of any origin; this one needs numpy and a few lines.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_client.errors import InvalidResponseError

__all__ = ["MAX_HEADER_BYTES", "PlyHeader", "read_header", "read_ply"]

MAX_HEADER_BYTES = 1 << 16
_DTYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
    **dict.fromkeys(("long", "int64"), "<i8"),
    **dict.fromkeys(("ulong", "uint64"), "<u8"),
}
_END = b"end_header\n"
_BINARY, _ASCII = "binary_little_endian", "ascii"


@dataclass(frozen=True)
class PlyHeader:
    """Header of a PLY file.

    Attributes:
        points: number of vertices.
        dtype: of one binary vertex; the names are those of the properties.
        start: offset of the first vertex in bytes.
        ascii: the vertices are lines of text.
    """

    points: int
    dtype: np.dtype[np.void]
    start: int
    ascii: bool


def read_header(beginning: bytes) -> PlyHeader:
    """Parse the header.

    Args:
        beginning: first bytes of the file, `MAX_HEADER_BYTES` of them suffice.

    Raises:
        InvalidResponseError: no PLY, or one with more than scalar vertex properties.
    """
    start = beginning.find(_END, 0, MAX_HEADER_BYTES) + len(_END)
    if start < len(_END):
        raise InvalidResponseError("the answer is no PLY: it has no end_header line")
    lines = [line.split() for line in _decode(beginning[:start]).split("\n")]
    elements = [words[1:] for words in lines if words and words[0] == "element"]
    columns = [words[1:] for words in lines if words and words[0] == "property"]
    if lines[0] != ["ply"] or lines[1] not in (
        ["format", kind, "1.0"] for kind in (_BINARY, _ASCII)
    ):
        raise InvalidResponseError("the answer is no PLY in ASCII or binary little endian")
    try:
        ((element, count),) = elements
        dtype = np.dtype([(name, _DTYPES[kind]) for kind, name in columns])
        points = int(count)
    except (KeyError, ValueError) as error:
        raise InvalidResponseError(f"the answer is a PLY of more than points: {error}") from error
    if element != "vertex" or not columns or points < 0:
        raise InvalidResponseError(
            f"the answer is a PLY of {count} {element}, {len(columns)} properties"
        )
    return PlyHeader(points, dtype, start, ascii=lines[1][1] == _ASCII)


def read_ply(data: bytes) -> dict[str, NDArray[np.generic]]:
    """Split a binary PLY into its vertex columns.

    Args:
        data: the whole file.

    Returns:
        Property name -> ``(M,)`` read-only array in the type and order of the file.

    Raises:
        InvalidResponseError: another kind of PLY, or more or fewer bytes than the header promises.
    """
    header = read_header(data)
    if header.ascii:
        raise InvalidResponseError("arrays are not read from a PLY in ASCII")
    size = len(data) - header.start
    if size != header.points * header.dtype.itemsize:
        raise InvalidResponseError(
            f"the answer promises {header.points} points of {header.dtype.itemsize} bytes "
            f"but has {size} bytes"
        )
    rows = np.frombuffer(data, dtype=header.dtype, count=header.points, offset=header.start)
    return {name: rows[name] for name in header.dtype.names or ()}


def _decode(header: bytes) -> str:
    try:
        return header.decode("utf-8")
    except UnicodeDecodeError:
        return header.decode("latin-1")
