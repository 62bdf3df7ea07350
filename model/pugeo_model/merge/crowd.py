# SPDX-License-Identifier: Apache-2.0
"""Neighbours among samples that know their chart: no tree, and density never matters.

A sample's neighbours belong to its own chart or to charts of that chart's nearest points, so a
handful of short lists is searched whatever the density there.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["by_chart", "crowd"]


def by_chart(owner: NDArray[np.int32], charts: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples sorted by chart: starts ``(charts + 1,)`` and sample rows ``(K,)``."""
    start = np.zeros(charts + 1, dtype=np.int64)
    np.cumsum(np.bincount(owner, minlength=charts), out=start[1:])
    return start, np.argsort(owner, kind="stable")


def crowd(
    samples: NDArray[np.float64],
    owner: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    reach: NDArray[np.float64],
    most: int,
) -> NDArray[np.int32]:
    """Samples within reach of each sample, nearest charts searched first.

    Args:
        samples: ``(K, 3)``.
        owner: ``(K,)`` chart of each.
        neighbours: ``(M, k)`` charts near each chart, nearest first.
        reach: ``(K,)`` distance.
        most: longest list.

    Returns:
        ``(K, most)`` int32 rows, ``-1`` beyond the end of a list.
    """
    start, order = by_chart(owner, len(neighbours))
    found = np.full((len(samples), most), -1, dtype=np.int32)
    _crowd(samples, owner, neighbours, reach, start, order, samples[order], found)
    return found


@njit(cache=True, nogil=True)
def _spheres(start, samples):  # type: ignore[no-untyped-def]
    """Centre and radius of what each chart holds, so that most charts are passed at one look."""
    charts = len(start) - 1
    spheres = np.zeros((charts, 4))
    for chart in range(charts):
        first, last = start[chart], start[chart + 1]
        if first == last:
            spheres[chart, 3] = -np.inf
            continue
        for a in range(3):
            total = 0.0
            for at in range(first, last):
                total += samples[at, a]
            spheres[chart, a] = total / (last - first)
        most = 0.0
        for at in range(first, last):
            d = 0.0
            for a in range(3):
                d += (samples[at, a] - spheres[chart, a]) ** 2
            most = max(most, d)
        # The rounding of the centre must not cost a neighbour.
        spheres[chart, 3] = np.sqrt(most) * (1.0 + 1e-9)
    return spheres


@njit(cache=True, nogil=True)
def _crowd(samples, owner, neighbours, reach, start, order, by_chart, found):  # type: ignore[no-untyped-def]
    k = neighbours.shape[1]
    most = found.shape[1]
    spheres = _spheres(start, by_chart)
    for i in range(len(samples)):
        x, y, z = samples[i, 0], samples[i, 1], samples[i, 2]
        limit = reach[i] * reach[i]
        filled = 0
        for near in range(-1, k):
            chart = owner[i] if near < 0 else neighbours[owner[i], near]
            a = spheres[chart, 0] - x
            b = spheres[chart, 1] - y
            c = spheres[chart, 2] - z
            far = max(spheres[chart, 3] + reach[i], 0.0)
            if a * a + b * b + c * c > far * far:
                continue
            for at in range(start[chart], start[chart + 1]):
                a = by_chart[at, 0] - x
                b = by_chart[at, 1] - y
                c = by_chart[at, 2] - z
                if a * a + b * b + c * c < limit:
                    j = order[at]
                    if j != i and filled < most:
                        found[i, filled] = j
                        filled += 1
