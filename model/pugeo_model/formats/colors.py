# SPDX-License-Identifier: Apache-2.0
"""The many ways to write a colour down, brought to eight bits."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["to_uint8"]


def to_uint8(values: NDArray[Any]) -> tuple[NDArray[np.uint8], str | None]:
    """Bring colour channels to 0..255.

    Floats are taken as 0..1, unless one exceeds 1: then as 0..255. Integers wider than eight
    bits are taken as 0..65535, unless none exceeds 255: many writers keep 8-bit colours in
    16-bit fields. All channels of one call share the scale.

    Args:
        values: numeric, any shape. NaN becomes 0; values outside the range are clipped.

    Returns:
        uint8 array of the same shape, and a note where the scale had to be guessed.
    """
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values), None
    if values.dtype.kind == "b":
        return values.astype(np.uint8) * np.uint8(255), None
    top = float(values[np.isfinite(values)].max(initial=0))
    note = None
    if values.dtype.kind == "f":
        factor = 255.0
        if top > 1.0:
            factor = 1.0
            note = f"Floating point colours reach {top:g}, so they were read as 0..255, not 0..1."
    elif top > 255.0:
        factor = 255.0 / 65535.0
    else:
        factor = 1.0
        if values.dtype.itemsize == 2:
            note = f"Colours are stored as {values.dtype} but none exceeds 255: read as 8 bits."
    scaled = np.nan_to_num(values * factor, nan=0.0, posinf=255.0, neginf=0.0)
    return np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8), note
