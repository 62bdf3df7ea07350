# SPDX-License-Identifier: Apache-2.0
"""Noisy regions that are flat: whatever is rough there is noise, and no detail.

Elsewhere moderate noise is left to the network, since averaging would cost as much detail. A region
is judged by itself, so that a scan may be noisy in one place and exact in another.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.quadric_at_points import QuadricsAtPoints
from pugeo_model.geometry.regions import Regions
from pugeo_model.tuning import TUNING

__all__ = ["is_flat_noise"]


def is_flat_noise(
    points: NDArray[np.float64], near: QuadricsAtPoints, region: Regions
) -> NDArray[np.bool_]:
    """Return which points lie in a flat region of noise, ``(M,)``.

    Args:
        points: ``(M, 3)``, unit scale.
        near: of these points.
        region: that contains them.
    """
    height = np.einsum("ni,ni->n", points, region.axis[region.of_point])
    height -= region.means(height[:, None])[region.of_point, 0]
    # 3 for noise with a normal distribution, 1 for both sides of a thin plate.
    fourth = region.means(height[:, None] ** 4)[:, 0]
    normal = fourth > TUNING.least_kurtosis * region.third**4
    usual = region.medians(near.thickness * near.spacing)
    rough = region.quantiles(near.thickness, TUNING.noise_quantile) > TUNING.flat_noise
    flat = region.spreads_two_ways & (region.third <= TUNING.only_noise * usual)
    noise: NDArray[np.bool_] = (flat & rough & normal)[region.of_point]
    return noise
