# SPDX-License-Identifier: Apache-2.0
"""Surface area of each input point; the density of the output follows it."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = [
    "area_of_spacing",
    "areas_of_quotas",
    "neighbour_mean",
    "spacing_of_area",
    "surface_areas",
]

_AREA = 0.756  # area of a point of an even sample, in squared spacings (mean distance to 8)
_NEAREST = 0.93  # mean distance to the nearest neighbour in the output, in roots of the area
_LARGE = 1e3  # log of an area ratio beyond all that occur


def surface_areas(
    spacing: NDArray[np.float32], neighbours: NDArray[np.int32], typical: float | None = None
) -> NDArray[np.float64]:
    """Estimate the surface area that each input point represents.

    Areas are averaged over neighbours several rounds, and small differences from the typical area
    are treated as random variation, so that they follow only the density of the input.

    Args:
        spacing: ``(M,)`` float32.
        neighbours: ``(M, k)`` rows near each point.
        typical: median spacing of the whole cloud; by default of these points.

    Returns:
        ``(M,)`` float64, in squared units of ``spacing``.
    """
    area: NDArray[np.float64] = neighbour_mean(
        _AREA * spacing.astype(np.float64) ** 2, neighbours, TUNING.area_rounds
    )
    typical_area = _AREA * (float(np.median(spacing)) if typical is None else typical) ** 2
    log_ratio = np.log(area / typical_area)
    reduced = np.interp(
        np.abs(log_ratio),
        [TUNING.even_area, TUNING.uneven_area, _LARGE],
        [0.0, TUNING.uneven_area, _LARGE],
    )
    areas: NDArray[np.float64] = typical_area * np.exp(np.copysign(reduced, log_ratio))
    return areas


def area_of_spacing(spacing: float) -> float:
    """Return the area per point of an output whose nearest neighbours are ``spacing`` apart."""
    return (spacing / _NEAREST) ** 2


def spacing_of_area(area: float) -> float:
    """Return the mean distance of nearest neighbours in an output with ``area`` per point."""
    return _NEAREST * float(np.sqrt(area))


def areas_of_quotas(quotas: NDArray[np.float64], usual_square: float) -> NDArray[np.float64]:
    """Return the surface areas ``(M,)`` of charts whose quotas are proportional to their areas.

    Args:
        quotas: ``(M,)``, see `area_quotas`.
        usual_square: squared spacing of the usual chart.
    """
    return _AREA * usual_square * quotas


@njit(cache=True, nogil=True)
def neighbour_mean(values, neighbours, rounds):  # type: ignore[no-untyped-def]
    """Replace each value by the mean of its neighbours' values, several rounds.

    Args:
        values: ``(M,)`` float64.
        neighbours: ``(M, k)`` rows.
        rounds: number of repetitions.

    Returns:
        ``(M,)`` float64.
    """
    current, following = values.copy(), np.empty_like(values)
    for _ in range(rounds):
        for i in range(len(neighbours)):
            total = 0.0
            for near in neighbours[i]:
                total += current[near]
            following[i] = total / neighbours.shape[1]
        current, following = following, current
    return current
