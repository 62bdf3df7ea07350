# SPDX-License-Identifier: Apache-2.0
"""Training inputs similar to sensor data: even, random, ramped, cut, in scan lines, noisy."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.mesh.virtual_sensors import random_direction, typical_spacing
from pugeo_model.training.corpus import SIZES, Shape

__all__ = ["Mix", "draw"]


@dataclass(frozen=True)
class Mix:
    """Probabilities of the kinds of input; the remainder is clean and even input.

    Attributes:
        noisy: even input with Gaussian noise.
        random: independent samples, half of them with little noise.
        ramp: density that falls to a quarter across the shape.
        cut: shape cut off by a plane.
        lines: scan lines, two to four times as dense along a line as across.
        sensors: scans of virtual sensors, see :mod:`~pugeo_model.mesh.virtual_sensors`.
        dense: many random points with noise of up to two spacings.
        noise: largest standard deviation of the noise of even input, in spacings.
    """

    noisy: float = 0.30
    random: float = 0.14
    ramp: float = 0.03
    cut: float = 0.03
    lines: float = 0.04
    sensors: float = 0.0
    dense: float = 0.0
    noise: float = 0.5


def draw(shape: Shape, mix: Mix, rng: np.random.Generator) -> tuple[NDArray[np.float64], float]:
    """Draw one input cloud of a shape.

    The probability of a size is proportional to its square root, since large clouds show more
    detail.

    Args:
        shape: the shape.
        mix: probabilities of the kinds of input.
        rng: source of random numbers.

    Returns:
        Points ``(M, 3)`` float64 and the standard deviation of their noise, in units of the shape.
    """
    size = rng.choice(len(SIZES), p=np.sqrt(SIZES) / np.sqrt(SIZES).sum())
    kind = rng.choice(
        6,
        p=[
            mix.noisy,
            mix.random,
            mix.ramp,
            mix.cut,
            mix.lines,
            1.0 - mix.noisy - mix.random - mix.ramp - mix.cut - mix.lines,
        ],
    )
    points: NDArray[Any] = shape.inputs[size]
    noise = 0.0
    if kind == 0:
        noise = rng.uniform(0.0, mix.noise)
    elif kind == 1:
        points = shape.pool[rng.choice(len(shape.pool), len(points), replace=False)]
        noise = rng.uniform(0.0, 0.15) if rng.random() < 0.5 else 0.0
    elif kind == 2:
        along = points @ random_direction(rng)
        rank = np.argsort(np.argsort(along)) / len(along)
        points = points[rng.random(len(points)) < 1.0 - 0.75 * rank]
    elif kind == 3:
        along = (points - points[rng.integers(len(points))]) @ random_direction(rng)
        kept = points[along > 0.0]
        points = kept if len(kept) > len(points) // 4 else points
    elif kind == 4:
        points = _scan_lines(shape.pool, rng)
        noise = rng.uniform(0.0, 0.1)
    points = points.astype(np.float64)
    if noise:
        noise *= typical_spacing(points)
        points = points + rng.normal(0.0, noise, points.shape)
    return points, noise


def _scan_lines(pool: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Samples near equidistant planes, thinned, so that lines are denser along than across."""
    height = pool @ random_direction(rng).astype(np.float32)
    # Bounded by the height, since no line might hit a thin shape otherwise.
    gap = min(rng.uniform(0.03, 0.06), float(np.ptp(height)) / 4.0)
    near = np.abs((height / gap) % 1.0 - 0.5) < 0.04
    rows = np.flatnonzero(near)
    keep = int(len(pool) * 0.08 * rng.uniform(0.3, 1.0))
    thinned: NDArray[np.float32] = pool[rng.permutation(rows)[: max(keep, 600)]]
    return thinned
