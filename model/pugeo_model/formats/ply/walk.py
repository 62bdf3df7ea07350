# SPDX-License-Identifier: Apache-2.0
"""Offsets of rows of different sizes, found row by row by a compiled loop."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pugeo_model.formats.ply.header import Element

__all__ = ["RowLayout", "find_segments", "row_layout"]


@dataclass(frozen=True)
class RowLayout:
    """A row as fixed segments, each followed by a list (the last one by nothing).

    Attributes:
        spans: ``(S, 4)`` int64: bytes of the fixed segment before the list's length; bytes of
            that length (0: no list); whether it is signed; bytes of one item.
        fields: property name -> its segment, its offset in that segment, its type.
    """

    spans: NDArray[np.int64]
    fields: dict[str, tuple[int, int, np.dtype[Any]]]


def row_layout(element: Element, order: str) -> RowLayout:
    """Cut a row into segments between lists."""
    spans: list[tuple[int, int, int, int]] = []
    fields: dict[str, tuple[int, int, np.dtype[Any]]] = {}
    shift = 0
    for each in element.properties:
        item = np.dtype(order + each.type)
        if each.count_type is None:
            fields[each.name] = (len(spans), shift, item)
            shift += item.itemsize
        else:
            count = np.dtype(each.count_type)
            spans.append((shift, count.itemsize, int(count.kind == "i"), item.itemsize))
            shift = 0
    spans.append((shift, 0, 0, 0))
    return RowLayout(np.array(spans, np.int64), fields)


def find_segments(
    data: NDArray[np.uint8], count: int, layout: RowLayout, big_endian: bool
) -> tuple[NDArray[np.int64], int, bool]:
    """Find where the segments of up to ``count`` rows begin.

    Returns:
        ``(n, S)`` byte offsets for the ``n`` rows that lie wholly in ``data``; the bytes they
        take; and whether the row after them has a list of impossible length.
    """
    offsets = np.empty((count, len(layout.spans)), np.int64)
    rows, used, broken = _compiled()(data, layout.spans, big_endian, offsets)
    return offsets[:rows], int(used), bool(broken)


def _walk_rows(
    data: NDArray[np.uint8],
    spans: NDArray[np.int64],
    big_endian: bool,
    offsets: NDArray[np.int64],
) -> tuple[int, int, bool]:
    size = len(data)
    begin = 0
    for row in range(len(offsets)):
        place = begin
        for segment in range(len(spans)):
            offsets[row, segment] = place
            place += spans[segment, 0]
            width = spans[segment, 1]
            if place + width > size:
                return row, begin, False
            if width > 0:
                length = 0
                for byte in range(width):
                    at = place + byte if big_endian else place + width - 1 - byte
                    length = length * 256 + int(data[at])
                if spans[segment, 2] == 1 and width < 8 and length >= 1 << (8 * width - 1):
                    length -= 1 << (8 * width)
                # No list of a file within limits has 2**40 items; this also keeps the sum exact.
                if length < 0 or length > 1 << 40:
                    return row, begin, True
                place += width + length * spans[segment, 3]
        if place > size:
            return row, begin, False
        begin = place
    return len(offsets), begin, False


@cache
def _compiled() -> Callable[..., tuple[int, int, bool]]:
    # Files with lists of different lengths are rare, and numba takes half a second to import.
    import numba

    return cast("Callable[..., tuple[int, int, bool]]", numba.njit(nogil=True)(_walk_rows))
