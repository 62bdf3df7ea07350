# SPDX-License-Identifier: Apache-2.0
"""How much of the surface each input point stands for: what the answer's density follows."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.tuning import TUNING

__all__ = ["neighbour_mean", "surface_areas"]

_AREA = 0.756  # of a point's share of the surface, in squared spacings (mean distance to 8)
_ANY = 1e3


def surface_areas(
    spacing: NDArray[np.float32], neighbours: NDArray[np.int32], typical: float | None = None
) -> NDArray[np.float64]:
    """Surface area that each input point stands for, ``(M,)``, unit scale.

    The density of the input is followed, its accidents are not: surface_areas are neighbour_mean over neighbours
    far and wide, and what is left of an even input's differences is not believed.

    Args:
        spacing: ``(M,)``.
        neighbours: ``(M, k)`` rows near each point.
        typical: spacing that half of the whole cloud's points have at most; by default of these.
    """
    area: NDArray[np.float64] = neighbour_mean(
        _AREA * spacing.astype(np.float64) ** 2, neighbours, TUNING.area_rounds
    )
    usual = _AREA * (float(np.median(spacing)) if typical is None else typical) ** 2
    apart = np.log(area / usual)
    believed = np.interp(
        np.abs(apart), [TUNING.even_area, TUNING.uneven_area, _ANY], [0.0, TUNING.uneven_area, _ANY]
    )
    share: NDArray[np.float64] = usual * np.exp(np.copysign(believed, apart))
    return share


@njit(cache=True, nogil=True)
def neighbour_mean(values, neighbours, times):  # type: ignore[no-untyped-def]
    """Means ``(M,)`` over neighbours ``(M, k)``, of means over neighbours, and so on."""
    now, after = values.copy(), np.empty_like(values)
    for _ in range(times):
        for i in range(len(neighbours)):
            total = 0.0
            for near in neighbours[i]:
                total += now[near]
            after[i] = total / neighbours.shape[1]
        now, after = after, now
    return now
