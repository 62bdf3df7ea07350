# SPDX-License-Identifier: Apache-2.0
"""Scales of colours, and colours packed into one number."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model.formats.colors import pack_rgb, to_channels, to_uint8, unpack_rgb


@pytest.mark.parametrize(
    ("values", "expected", "noted"),
    [
        (np.array([0, 0.5, 1.0]), [0, 128, 255], False),
        (np.array([0, 0.5, 1.04]), [0, 128, 255], True),
        (np.array([0.0, 1.0, 2.0]), [0, 1, 2], True),
        (np.array([0.0, 128.5, 255.0]), [0, 128, 255], True),
        (np.array([np.nan, -1.0, 0.2]), [0, 0, 51], False),
        (np.array([0, 9, 255], np.uint16), [0, 9, 255], True),
        (np.array([0, 9, 256], np.uint16), [0, 9, 256], False),
        (np.array([0.0, 9.0, 65535.0]), [0, 9, 65535], True),
        (np.array([-1, 9, 99_999], np.int32), [0, 9, 65535], False),
        (np.array([True, False]), [255, 0], False),
    ],
)
def test_scales(values: NDArray[Any], expected: list[int], noted: bool) -> None:
    """The scale is that of the values as a whole; a guess or a clipped value is noted."""
    found, note = to_channels(values)
    assert found.tolist() == expected
    assert found.dtype == (np.uint16 if max(expected) > 255 else np.uint8)
    assert (note is not None) == noted


def test_overshoot_of_a_few() -> None:
    """One value of a thousand far above 1 is clipped; the other colours stay as they are."""
    values = np.random.default_rng(0).uniform(0, 1, 3000)
    values[7] = 40.0
    found, note = to_channels(values)
    assert found[7] == 255
    others = np.delete(found, 7).astype(np.float64)
    np.testing.assert_allclose(others, np.delete(values, 7) * 255, rtol=0, atol=0.501)
    assert note == "1 colour values above 1 (at most 40) were clipped to 1."


def test_narrowing() -> None:
    """16 bits become 8 with white staying white."""
    found, _ = to_uint8(np.array([0, 128, 129, 257, 65535], np.uint16))
    assert found.tolist() == [0, 0, 1, 1, 255]


@pytest.mark.parametrize("alpha", [0, 127, 255])
def test_packed(alpha: int) -> None:
    """Packed colours unpack from float bits, whole floats, and integers of both signs."""
    colors = np.random.default_rng(0).integers(0, 256, (500, 3)).astype(np.uint8)
    wide = colors.astype(np.uint32)
    bits = np.uint32(alpha) << 24 | wide[:, 0] << 16 | wide[:, 1] << 8 | wide[:, 2]
    for packed in (bits, bits.astype(np.int64), bits.view(np.int32), bits.astype(np.float64)):
        np.testing.assert_array_equal(unpack_rgb(packed), colors)
    if alpha == 0:
        np.testing.assert_array_equal(unpack_rgb(pack_rgb(colors)), colors)
        np.testing.assert_array_equal(unpack_rgb(pack_rgb(colors).astype(np.float64)), colors)
    if alpha == 255:
        np.testing.assert_array_equal(unpack_rgb(bits.view(np.float32)), colors)


def test_not_packed() -> None:
    """Numbers that cannot be packed colours stay what they are."""
    assert unpack_rgb(np.array([0.5, 1.5])) is None
    assert unpack_rgb(np.array([-5.0, 1.0])) is None
    assert unpack_rgb(np.array([2**40])) is None
