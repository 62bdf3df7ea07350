# SPDX-License-Identifier: Apache-2.0
"""How much of the surface each input point stands for: what the answer's density follows."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["averaged", "shares"]

_AREA = 0.756  # of a point's share of the surface, in squared spacings (mean distance to 8)
_WIDE = 8  # times that shares are averaged over neighbours
_EVEN = 0.06  # logarithm of the largest ratio to the typical share that is taken for an accident
_UNEVEN = 0.18  # of the smallest that is taken as it is
_ANY = 1e3


def shares(
    spacing: NDArray[np.float32], neighbours: NDArray[np.int32], typical: float | None = None
) -> NDArray[np.float64]:
    """Surface area that each input point stands for, ``(M,)``, unit scale.

    The density of the input is followed, its accidents are not: shares are averaged over neighbours
    far and wide, and what is left of an even input's differences is not believed.

    Args:
        spacing: ``(M,)``.
        neighbours: ``(M, k)`` rows near each point.
        typical: spacing that half of the whole cloud's points have at most; by default of these.
    """
    area: NDArray[np.float64] = averaged(_AREA * spacing.astype(np.float64) ** 2, neighbours, _WIDE)
    usual = _AREA * (float(np.median(spacing)) if typical is None else typical) ** 2
    apart = np.log(area / usual)
    believed = np.interp(np.abs(apart), [_EVEN, _UNEVEN, _ANY], [0.0, _UNEVEN, _ANY])
    share: NDArray[np.float64] = usual * np.exp(np.copysign(believed, apart))
    return share


@njit(cache=True, nogil=True)
def averaged(values, neighbours, times):  # type: ignore[no-untyped-def]
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
