# SPDX-License-Identifier: Apache-2.0
"""A small request that every worker, and then the engine as a whole, does before any other."""

import io

import numpy as np
from numpy.typing import NDArray

from pugeo_model import formats
from pugeo_model.cloud import Cloud
from pugeo_service.engine.messages import Order

__all__ = ["sample_body", "sample_order"]

# More than one patch, so that whatever joins patches is exercised too.
_POINTS = 3000


def sample_body() -> NDArray[np.uint8]:
    """Return a sphere as a PLY file, uint8."""
    directions = np.random.default_rng(0).normal(size=(_POINTS, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return np.frombuffer(buffer.getvalue(), np.uint8)


def sample_order(model: str, deadline_s: float) -> Order:
    """Return the order to upsample it."""
    return Order(
        model=model,
        format=None,
        answer="ply",
        options={"ratio": 2.0},
        max_points=_POINTS,
        max_output_points=2 * _POINTS,
        batch_patches=1,
        deadline_s=deadline_s,
    )
