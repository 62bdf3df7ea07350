# SPDX-License-Identifier: Apache-2.0
"""A small request that every worker, and then the engine as a whole, runs before any other."""

import io

import numpy as np
from numpy.typing import NDArray

from pugeo_model import formats
from pugeo_model.cloud import Cloud
from pugeo_service.engine.messages import ModelId, RunRequest

__all__ = ["self_test_body", "self_test_request"]

# More than one patch, so that the code that joins patches runs too.
_POINTS = 3000
_BYTES = 1 << 30  # more than it takes


def self_test_body() -> NDArray[np.uint8]:
    """Return a sphere as a PLY file, uint8."""
    directions = np.random.default_rng(0).normal(size=(_POINTS, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return np.frombuffer(buffer.getvalue(), np.uint8)


def self_test_request(model: ModelId, deadline_s: float) -> RunRequest:
    """Return the request to upsample it."""
    return RunRequest(
        model=model,
        format=None,
        answer="ply",
        options={"ratio": 2.0},
        max_points=_POINTS,
        max_output_points=2 * _POINTS,
        max_cloud_bytes=_BYTES,
        max_output_bytes=_BYTES,
        deadline_s=deadline_s,
    )
