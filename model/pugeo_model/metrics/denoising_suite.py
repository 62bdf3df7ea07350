# SPDX-License-Identifier: Apache-2.0
"""Denoising as the literature measures it: even points in the unit sphere with Gaussian noise.

The figure is the sum of both mean squared distances to the points without noise, of the answer over
that of the noisy input: the share of the noise that is left.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.metrics.clouds import nearest_both
from pugeo_model.metrics.evaluation import Truth
from pugeo_model.upsampler import Upsampler

__all__ = ["rows"]

_COUNTS = (10_000, 50_000)
_NOISE = (0.01, 0.02)  # standard deviations, radius of the sphere 1


def rows(upsampler: Upsampler, truth: Truth) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Measure one shape: yields input, method and columns.

    The method ``moved`` has the input's points on the surface, ``sample`` a new sample of as many
    points, ``limit`` an even sample that is independent of the input.
    """
    for count in _COUNTS:
        clean = truth.even(count).points.astype(np.float64)
        centre = (clean.min(axis=0) + clean.max(axis=0)) / 2
        radius = float(np.linalg.norm(clean - centre, axis=1).max())
        true = (clean - centre) / radius
        other = (truth.even(count + 1).points[:count] - centre) / radius
        for noise in _NOISE:
            name = f"{count:,} points, {100 * noise:.0f} %"
            rng = np.random.default_rng([count, round(1e4 * noise)])
            noisy = true + rng.normal(0.0, noise, true.shape)
            before = _both_squared(noisy, true)
            cloud = Cloud(noisy.astype(np.float32))
            moved = upsampler(cloud, 1.0, denoise=True).cloud.points
            # A ratio of exactly 1 would keep the input's own points.
            more = upsampler(cloud, n_points=count + 1).cloud.points
            for method, points in (("moved", moved), ("sample", more), ("limit", other)):
                yield name, method, {"left": _both_squared(points, true) / before}


def _both_squared(points: NDArray[np.floating], true: NDArray[np.float64]) -> float:
    there, back = nearest_both(points.astype(np.float64), true)
    return float((there**2).mean() + (back**2).mean())
