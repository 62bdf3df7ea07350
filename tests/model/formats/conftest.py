# SPDX-License-Identifier: Apache-2.0
"""Clouds and reading shortcuts for the file formats."""

import io
from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.formats import Limits, read, write


@pytest.fixture
def rich() -> Cloud:
    """Seven points with everything that can ride along."""
    rng = np.random.default_rng(7)
    return Cloud(
        points=rng.normal(size=(7, 3)).astype(np.float32),
        normals=rng.normal(size=(7, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (7, 4)).astype(np.uint8),
        scalars={
            "scalar_Intensity": rng.random(7).astype(np.float32),
            "time": rng.random(7) * 1e9,
            "class": np.arange(7, dtype=np.uint8),
            "index": np.arange(7, dtype=np.int32) - 3,
        },
    )


@pytest.fixture
def parse() -> Callable[..., Cloud]:
    """Read a cloud from bytes."""

    def from_bytes(data: bytes, **limits: int) -> Cloud:
        return read(io.BytesIO(data), limits=Limits(**limits))

    return from_bytes


@pytest.fixture
def dump() -> Callable[[Cloud, str], bytes]:
    """Write a cloud to bytes."""

    def to_bytes(cloud: Cloud, name: str) -> bytes:
        buffer = io.BytesIO()
        write(cloud, buffer, format=name)
        return buffer.getvalue()

    return to_bytes
