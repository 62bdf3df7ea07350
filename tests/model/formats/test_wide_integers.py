# SPDX-License-Identifier: Apache-2.0
"""Integers that doubles cannot hold keep their bits, or a note names them."""

import io

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.formats import WRITABLE, dropped, read, write

POINTS = np.random.default_rng(0).normal(size=(4, 3))
WIDE = np.array([2**53 + 1, 2**60 + 3, -(2**61) - 1, 0])


@pytest.mark.parametrize("format", list(WRITABLE))
@pytest.mark.parametrize("values", [WIDE, WIDE.view(np.uint64), np.array([0, 1, 2**53, 3])])
def test_bits_or_a_note(format: str, values: np.ndarray) -> None:
    """Each format keeps every value, or says by name which ones it does not."""
    cloud = Cloud(POINTS, scalars={"track": values})
    buffer = io.BytesIO()
    write(cloud, buffer, format=format)
    buffer.seek(0)
    back = read(buffer, format=format).scalars.get("track")
    kept = back is not None and [int(value) for value in back] == [int(value) for value in values]
    assert kept or "track" in (dropped(cloud, format) or "")
    if kept:
        assert "track" not in (dropped(cloud, format) or "")
