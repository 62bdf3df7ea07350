# SPDX-License-Identifier: Apache-2.0
"""Answers on closed forms in the patterns of sensors: nearer to the surface, with its normals."""

import pytest
import torch
from benchmarks.sensor_patterns import Pattern, measure, patterns

from pugeo_model.upsampler import Upsampler

_BOUNDS = {
    "depth": (0.5, 2.0),
    "disparity": (0.3, 2.0),
    "square": (0.25, 1.5),
    "hexagonal": (0.25, 1.5),
    "brick": (0.25, 1.5),
    "holes": (0.3, 1.5),
    "random": (0.25, 1.5),
    "half": (0.35, 2.0),
    "frames": (0.25, 3.5),
    "rings": (1.0, 1.0),
    "ball": (0.35, 6.0),
    "lines": (0.6, 3.0),
}
"""Largest error of the answer, as a share of the scan's, and largest mean angle of the normals."""


@pytest.fixture(scope="module")
def upsampler() -> Upsampler:
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


@pytest.mark.parametrize("pattern", list(patterns()), ids=lambda pattern: pattern.name)
def test_the_surface_is_found(upsampler: Upsampler, pattern: Pattern) -> None:
    """The nearest points show no surface, or none without error; those around them do."""
    left, degrees = _BOUNDS[pattern.name.split()[0]]
    answer = measure(upsampler, pattern)
    assert answer.error <= left * answer.scan
    assert answer.degrees <= degrees
    # A grazing ray is on the wrong side of a normal that is off by little.
    assert answer.facing > 0.97
