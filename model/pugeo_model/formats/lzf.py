# SPDX-License-Identifier: Apache-2.0
"""LZF decompression, the compression of PCD files.

A control byte below 32 is followed by that many bytes plus one, taken as they are. Otherwise its
upper three bits are a length (7: one more byte is added), its lower five bits and the next byte a
distance: so many bytes plus two are copied from that far back in the output (M. Lehmann, LibLZF).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

__all__ = ["LARGEST_RATIO", "decompress"]

LARGEST_RATIO = 88
"""Bytes that one compressed byte gives at most: three bytes stand for 264."""


def decompress(data: bytes, size: int) -> NDArray[np.uint8] | None:
    """Decompress to exactly ``size`` bytes; ``None`` where the data are not of that size."""
    if size > LARGEST_RATIO * len(data):
        return None
    out = np.zeros(size, np.uint8)
    return out if _compiled()(np.frombuffer(data, np.uint8), out) else None


def _expand(data: NDArray[Any], out: NDArray[Any]) -> bool:
    size, room = len(data), len(out)
    read = written = 0
    while read < size:
        control = int(data[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > size or written + length > room:
                return False
            for index in range(length):
                out[written + index] = data[read + index]
            read += length
        else:
            length = control >> 5
            if length == 7:
                if read >= size:
                    return False
                length += int(data[read])
                read += 1
            length += 2
            if read >= size:
                return False
            start = written - ((control & 31) << 8) - int(data[read]) - 1
            read += 1
            if start < 0 or written + length > room:
                return False
            # Byte by byte: the copy may overlap what it writes.
            for index in range(length):
                out[written + index] = out[start + index]
        written += length
    return written == room


@cache
def _compiled() -> Callable[..., bool]:
    # numba takes half a second to import, and few files need it.
    import numba

    return cast("Callable[..., bool]", numba.njit(nogil=True)(_expand))
