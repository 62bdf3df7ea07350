# SPDX-License-Identifier: Apache-2.0
"""A cloud as PLY bytes: the header first, known before any row, then rows in blocks."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud

__all__ = ["RESERVED", "Column", "body", "columns", "encode", "header", "rounded", "size"]

_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_BLOCK_ROWS = 16_384
_EXACT = 2**53  # doubles have all whole numbers up to here
_POINTS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_COLORS = ("red", "green", "blue", "alpha")
# A scalar of such a name would be taken for something else by some reader.
RESERVED = frozenset(
    [
        *_POINTS,
        *_NORMALS,
        *("normal_x", "normal_y", "normal_z"),
        *_COLORS,
        *(f"diffuse_{name}" for name in _COLORS),
        *"rgba",
        *("rgb", "rgba"),
    ]
)


@dataclass(frozen=True)
class Column:
    """A column of the file: its name, its numpy type without byte order, its values."""

    name: str
    type: str
    values: NDArray[Any]


def header(cloud: Cloud, *, count: int | None = None, text: bool = False) -> bytes:
    """Build the header for a cloud, or for ``count`` points like its own.

    Binary little endian, or ``text``.
    """
    lines = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    lines.append(f"element vertex {len(cloud) if count is None else count}")
    lines += [f"property {_NAMES[each.type]} {each.name}" for each in columns(cloud)]
    return "\n".join([*lines, "end_header", ""]).encode()


def body(cloud: Cloud, *, text: bool = False) -> Iterator[bytes]:
    """Yield the rows of a cloud, some thousand at a time."""
    table = columns(cloud)
    row_type = np.dtype([(each.name, "<" + each.type) for each in table])
    line = " ".join(_digits(each.type) for each in table) + "\n"
    for start in range(0, len(cloud), _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, len(cloud))
        if text:
            cells = np.empty((stop - start, len(table)), object)
            for index, each in enumerate(table):
                cells[:, index] = each.values[start:stop].astype(each.type).tolist()
            yield (line * (stop - start) % tuple(cells.ravel().tolist())).encode()
        else:
            rows = np.empty(stop - start, row_type)
            for each in table:
                rows[each.name] = each.values[start:stop]
            yield rows.tobytes()


def encode(cloud: Cloud, *, text: bool = False) -> Iterator[bytes]:
    """Yield a whole file: header, then rows."""
    yield header(cloud, text=text)
    yield from body(cloud, text=text)


def size(cloud: Cloud) -> int:
    """Bytes of the binary file, without writing it."""
    row = sum(np.dtype(each.type).itemsize for each in columns(cloud))
    return len(header(cloud)) + len(cloud) * row


def columns(cloud: Cloud) -> list[Column]:
    """List the columns of a cloud: points, normals, colours, scalars."""
    kind = _type_of(cloud.points)
    found = [Column(n, kind, v) for n, v in zip(_POINTS, cloud.points.T, strict=True)]
    if cloud.normals is not None:
        found += [Column(n, "f4", v) for n, v in zip(_NORMALS, cloud.normals.T, strict=True)]
    if cloud.colors is not None:
        kind = _type_of(cloud.colors)
        found += [Column(n, kind, v) for n, v in zip(_COLORS, cloud.colors.T, strict=False)]
    taken = set(RESERVED)
    for name, values in cloud.scalars.items():
        written = _free_name(name, taken)
        taken.add(written)
        found.append(Column(written, _type_of(values), values))
    return found


def rounded(cloud: Cloud) -> list[str]:
    """Name the integers that some value of is rounded, since they are written as doubles."""
    return [
        f"the bits of {name} beyond 2^53"
        for name, values in cloud.scalars.items()
        if values.dtype.kind in "iu"
        and _type_of(values) == "f8"
        and max(-int(values.min()), int(values.max())) > _EXACT
    ]


def _free_name(name: str, taken: set[str]) -> str:
    """Make a name a single word (it may come from a client) that no other column has."""
    word = re.sub(r"[^\w.+\-#%()\[\]/]+", "_", name)[:200] or "scalar"
    free = word if word not in taken else f"scalar_{word}"
    number = 2
    while free in taken:
        free = f"scalar_{word}_{number}"
        number += 1
    return free


def _type_of(values: NDArray[Any]) -> str:
    """Choose a type that every reader knows: PLY has no half floats and no 64-bit integers."""
    match values.dtype.kind, values.dtype.itemsize:
        case "b", _:
            return "u1"
        case "f", width:
            return "f4" if width <= 4 else "f8"
        case _, width if width <= 4:
            return f"{values.dtype.kind}{width}"
    low, high = values.min(initial=0), values.max(initial=0)
    for kind in ("i4", "u4"):
        if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
            return kind
    return "f8"


def _digits(kind: str) -> str:
    return {"f4": "%.9g", "f8": "%.17g"}.get(kind, "%d")
