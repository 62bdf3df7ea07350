# SPDX-License-Identifier: Apache-2.0
"""The many encodings of a colour, brought to eight or sixteen bits a channel."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["pack_rgb", "to_channels", "to_uint8", "unpack_rgb"]

_FEW = 0.01
"""Share of values above 1 that still counts as overshoot of colours in 0..1."""


def to_channels(
    values: NDArray[Any],
) -> tuple[NDArray[np.uint8] | NDArray[np.uint16], str | None]:
    """Bring colour channels to uint8, or to uint16 where they are finer than that.

    Floats are taken as 0..1 as long as at most 1 % of them exceed 1 or none exceeds 2, and are not
    all whole: blending and spherical harmonics overshoot a little. Else they are 0..255, or
    0..65535 where one exceeds 255. Integers wider than eight bits are taken as 0..65535, unless
    none exceeds 255: many writers keep 8-bit colours in 16-bit fields. All channels of one call
    share the scale.

    Args:
        values: numeric, any shape. NaN becomes 0; values outside the range are clipped.

    Returns:
        uint8 or uint16 array of the same shape, and a note where a scale was guessed or clipped.
    """
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values), None
    if values.dtype.kind == "b":
        return values.astype(np.uint8) * np.uint8(255), None
    if values.dtype.kind == "f":
        return _floats(values)
    top = int(values.max(initial=0))
    if top > 255:
        return np.clip(values, 0, 65535).astype(np.uint16), None
    note = None
    if values.dtype.itemsize == 2:
        note = f"Colours are stored as {values.dtype} but none exceeds 255: read as 8 bits."
    return np.clip(values, 0, 255).astype(np.uint8), note


def _floats(
    values: NDArray[Any],
) -> tuple[NDArray[np.uint8] | NDArray[np.uint16], str | None]:
    known = values[np.isfinite(values)]
    top = float(known.max(initial=0))
    above = int(np.count_nonzero(known > 1.0))
    if not above:
        return _scaled(values, 255.0), None
    overshoot = top <= 2.0 or above <= _FEW * known.size
    if overshoot and (known != np.rint(known)).any():
        note = f"{above:,} colour values above 1 (at most {top:g}) were clipped to 1."
        return _scaled(values, 255.0), note
    if top <= 256.0:
        note = f"Floating point colours reach {top:g}, so they were read as 0..255, not 0..1."
        return _scaled(values, 1.0), note
    note = f"Floating point colours reach {top:g}, so they were read as 0..65535 (16 bits)."
    filled = np.nan_to_num(values, nan=0.0, posinf=65535.0, neginf=0.0)
    return np.rint(np.clip(filled, 0.0, 65535.0)).astype(np.uint16), note


def _scaled(values: NDArray[Any], factor: float) -> NDArray[np.uint8]:
    with np.errstate(over="ignore"):
        scaled = np.nan_to_num(values * factor, nan=0.0, posinf=255.0, neginf=0.0)
    return np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)


def to_uint8(values: NDArray[Any]) -> tuple[NDArray[np.uint8], str | None]:
    """Bring colour channels to 0..255, as `to_channels` understands them.

    Returns:
        uint8 array of the same shape, and a note where a scale was guessed or bits were lost.
    """
    channels, note = to_channels(values)
    if channels.dtype == np.uint8:
        return channels.astype(np.uint8, copy=False), note
    # 65535 / 255 = 257, so that white stays white.
    return ((channels.astype(np.uint32) + 128) // 257).astype(np.uint8), note


def unpack_rgb(values: NDArray[Any]) -> NDArray[np.uint8] | None:
    """Unpack colours that are packed into one number each, as PCL does: 0x00RRGGBB or 0xAARRGGBB.

    Args:
        values: ``(M,)`` integers; or floats, either whole, or float32 whose bits are the integer
            (float64 that came from such float32 by way of text as well).

    Returns:
        ``(M, 3)`` uint8, or ``None`` where the numbers cannot be packed colours.
    """
    bits: NDArray[Any]
    if values.dtype.kind == "f":
        known = values[np.isfinite(values)]
        # As bits, 0x00RRGGBB is a denormal float; with an opaque alpha it is NaN or very negative.
        packed = (np.abs(known) < 2.4e-38) | (known < -1e37)
        if packed.all():
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):
                bits = values.astype(np.float32).view(np.uint32)
        elif ((known == np.rint(known)) & (known >= 0) & (known < 2**32)).all():
            bits = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0).astype(np.uint32)
        else:
            return None
    else:
        wide = values.astype(np.int64)
        # PCL's signed variant of the field wraps for an alpha of 128 and more.
        if (wide < -(2**31)).any() or (wide >= 2**32).any():
            return None
        bits = (wide & 0xFFFFFFFF).astype(np.uint32, copy=False)
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)


def pack_rgb(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Pack ``(M, 3|4)`` colours into the float32 that PCL writes as the field ``rgb``."""
    channels = to_uint8(colors)[0].astype(np.uint32)
    packed = channels[:, 0] << 16 | channels[:, 1] << 8 | channels[:, 2]
    return packed.astype(np.uint32).view(np.float32)
