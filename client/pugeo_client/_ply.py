# SPDX-License-Identifier: Apache-2.0
"""Read the PLY that the service writes: binary little endian, scalar vertex properties only.

A reader for PLY from anywhere stands in the service; this one needs numpy and 40 lines.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_client.errors import InvalidResponseError

__all__ = ["read_ply"]

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
_LONGEST_HEADER = 1 << 16


def read_ply(data: bytes) -> dict[str, NDArray[np.generic]]:
    """Split a PLY into its vertex columns.

    Args:
        data: the whole file.

    Returns:
        property name -> ``(M,)`` read-only array in the file's own type, in the file's order.

    Raises:
        InvalidResponseError: another kind of PLY, or more or fewer bytes than the header promises.
    """
    start = data.find(_END, 0, _LONGEST_HEADER) + len(_END)
    if start < len(_END):
        raise InvalidResponseError("the answer is no PLY: it has no end_header line")
    count, dtype = _layout(data[:start].decode("latin-1"))
    if len(data) - start != count * dtype.itemsize:
        raise InvalidResponseError(
            f"the answer promises {count} points of {dtype.itemsize} bytes "
            f"but has {len(data) - start} bytes"
        )
    rows = np.frombuffer(data, dtype=dtype, count=count, offset=start)
    return {name: rows[name] for name in dtype.names or ()}


def _layout(header: str) -> tuple[int, np.dtype[np.void]]:
    """Read how many vertices of which type follow."""
    lines = [line.split() for line in header.splitlines()]
    elements = [words[1:] for words in lines if words and words[0] == "element"]
    columns = [words[1:] for words in lines if words and words[0] == "property"]
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InvalidResponseError("the answer is no binary little-endian PLY")
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
    return points, dtype
