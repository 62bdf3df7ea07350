# SPDX-License-Identifier: Apache-2.0
"""Regions whose small neighbourhoods all have another normal than the region itself.

The nearest points of one ring of a spinning scanner are a ribbon along its rays, and those of
stacked frames a sheet along the rays. Each is flat and thin, so that only a larger region shows
that it is not the surface. On a true surface, noisy or curved, the mean of the normals of small
neighbourhoods is the normal of the region.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.regions import Regions
from pugeo_model.tuning import TUNING

__all__ = ["least_unbiased_spacing"]

_DEPENDENT = 8.0  # normals near each other that count as one: they share most of their points
_ENOUGH = 0.2  # share of the points of a region with a normal, from which it can be judged
_DEVIATIONS = 3.0  # standard errors from which a mean normal is not one by chance


def least_unbiased_spacing(
    normals: NDArray[np.float64], known: NDArray[np.bool_], regions: list[Regions]
) -> NDArray[np.float64]:
    """Least spacing that charts need where small neighbourhoods have false normals, else 0.

    Args:
        normals: ``(M, 3)`` unit normals of the nearest points of each, of any sign.
        known: ``(M,)`` the nearest points are no line, which has no normal.
        regions: that contain the points, from small to large.

    Returns:
        ``(M,)`` float64, unit scale.
    """
    least = np.zeros(len(normals))
    for region in regions:
        # The ball of a chart has a radius of two spacings: half a side.
        needed = np.maximum(region.third / TUNING.thin_sheet, 0.25 * region.side)
        now = np.where(_is_biased(normals, known, region), needed, 0.0)
        least = np.where(least > 0.0, least, now[region.of_point])
    return least


def _is_biased(
    normals: NDArray[np.float64], known: NDArray[np.bool_], region: Regions
) -> NDArray[np.bool_]:
    """Return which flat regions have false normals, ``(g,)``."""
    share = region.means(known[:, None].astype(np.float64))[:, 0]
    cosine = np.einsum("ni,ni->n", normals, region.axis[region.of_point])
    aligned = normals * (known * np.where(cosine < 0.0, -1.0, 1.0))[:, None]
    mean = region.means(aligned) / np.maximum(share, 1e-12)[:, None]
    length = np.linalg.norm(mean, axis=1)
    along = np.einsum("gi,gi->g", mean, region.axis) / np.maximum(length, 1e-12)
    bias = np.arccos(np.clip(along, -1.0, 1.0))
    # Standard error of the mean: the length of a mean of unit vectors tells how they scatter.
    scatter = np.sqrt(np.maximum(1.0 - length**2, 0.0))
    error = scatter / np.sqrt(np.maximum(share * region.count / _DEPENDENT, 1.0))
    slope = region.third / np.maximum(region.second, 1e-300)
    bound = np.maximum(TUNING.bias_of_curved * slope, _DEVIATIONS * error)
    turned = bias > np.maximum(np.radians(TUNING.least_bias), bound)
    across = region.medians(np.abs(cosine), known) < np.cos(np.radians(TUNING.across))
    flat = region.spreads_two_ways & (slope <= TUNING.flat_region) & (share > _ENOUGH)
    biased: NDArray[np.bool_] = flat & (turned | across)
    return biased
