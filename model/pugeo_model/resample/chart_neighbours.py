# SPDX-License-Identifier: Apache-2.0
"""Neighbours among samples grouped by chart.

The neighbours of a sample belong to its own chart or to the charts next to it, so only a few
short lists are searched, at any density, and no tree is built.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit

__all__ = ["chart_neighbours", "group_by_chart"]


def group_by_chart(
    owner: NDArray[np.int32], charts: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Group samples by chart (counting sort).

    Args:
        owner: ``(K,)`` int32 chart of each sample.
        charts: number of charts.

    Returns:
        Start of each chart ``(charts + 1,)`` int64 in the sample rows ``(K,)`` int32, which
        ascend within each chart.
    """
    start = np.zeros(charts + 1, dtype=np.int64)
    order = np.empty(len(owner), dtype=np.int32)
    _sort(owner, start, order)
    return start, order


def chart_neighbours(
    samples: NDArray[np.float64],
    owner: NDArray[np.int32],
    neighbours: NDArray[np.int32],
    radius: NDArray[np.float64],
    most: int,
) -> NDArray[np.int32]:
    """Find the samples within a radius of each sample.

    Args:
        samples: ``(K, 3)`` float64.
        owner: ``(K,)`` int32 chart of each sample.
        neighbours: ``(M, k)`` charts near each chart, nearest first; searched in this order.
        radius: ``(K,)`` largest distance.
        most: length of the longest list; further neighbours are dropped.

    Returns:
        ``(K, most)`` int32 rows, ``-1`` beyond the end of a list.
    """
    start, order = group_by_chart(owner, len(neighbours))
    found = np.empty((len(samples), most), dtype=np.int32)
    _chart_neighbours(samples, neighbours, radius, start, order, found)
    return found


@njit(cache=True, nogil=True)
def _sort(owner, start, order):  # type: ignore[no-untyped-def]
    for chart in owner:
        start[chart + 1] += 1
    for chart in range(1, len(start)):
        start[chart] += start[chart - 1]
    fill = start[:-1].copy()
    for i in range(len(owner)):
        order[fill[owner[i]]] = i
        fill[owner[i]] += 1


@njit(cache=True, nogil=True)
def _spheres(start, order, samples):  # type: ignore[no-untyped-def]
    """Bounding sphere of the samples of each chart ``(charts, 4)``, to skip most charts quickly."""
    charts = len(start) - 1
    spheres = np.zeros((charts, 4))
    for chart in range(charts):
        first, last = start[chart], start[chart + 1]
        if first == last:
            spheres[chart, 3] = -np.inf
            continue
        x = y = z = most = 0.0
        for at in range(first, last):
            x += samples[order[at], 0]
            y += samples[order[at], 1]
            z += samples[order[at], 2]
        x /= last - first
        y /= last - first
        z /= last - first
        for at in range(first, last):
            a = samples[order[at], 0] - x
            b = samples[order[at], 1] - y
            c = samples[order[at], 2] - z
            most = max(most, a * a + b * b + c * c)
        spheres[chart, 0], spheres[chart, 1], spheres[chart, 2] = x, y, z
        # Slightly larger, so that rounding to float32 drops no neighbour.
        spheres[chart, 3] = np.sqrt(most) * (1.0 + 1e-6)
    return spheres


@njit(cache=True, nogil=True, fastmath=True)
def _flag(x, y, z, limit, count, xs, ys, zs, within):  # type: ignore[no-untyped-def]
    """Flag the leading ``count`` samples within the squared limit; vectorised, without a branch."""
    for at in range(count):
        a = xs[at] - x
        b = ys[at] - y
        c = zs[at] - z
        within[at] = a * a + b * b + c * c < limit


@njit(cache=True, nogil=True)
def _gather(chart, widest, samples, neighbours, spheres, start, order, xs, ys, zs, rows):  # type: ignore[no-untyped-def]
    """Gather the samples of a chart, then of the charts around it; returns their number.

    Coordinates are float32 relative to the chart: precise enough, and the processor compares
    sixteen at a time.
    """
    x, y, z = spheres[chart, 0], spheres[chart, 1], spheres[chart, 2]
    count = 0
    for near in range(-1, neighbours.shape[1]):
        other = chart if near < 0 else neighbours[chart, near]
        a, b, c = spheres[other, 0] - x, spheres[other, 1] - y, spheres[other, 2] - z
        limit = max(spheres[other, 3] + widest, 0.0)
        if a * a + b * b + c * c > limit * limit:
            continue
        for at in range(start[other], start[other + 1]):
            j = order[at]
            a, b, c = samples[j, 0] - x, samples[j, 1] - y, samples[j, 2] - z
            rows[count], xs[count], ys[count], zs[count] = j, a, b, c
            # Without a branch: a sample beyond every radius is overwritten by the next one.
            count += a * a + b * b + c * c <= widest * widest
    return count


@njit(cache=True, nogil=True)
def _longest(start, neighbours):  # type: ignore[no-untyped-def]
    """Largest number of samples in a chart and the charts around it."""
    longest = 0
    for chart in range(len(neighbours)):
        total = start[chart + 1] - start[chart]
        for near in neighbours[chart]:
            total += start[near + 1] - start[near]
        longest = max(longest, total)
    return longest


@njit(cache=True, nogil=True)
def _chart_neighbours(samples, neighbours, radius, start, order, found):  # type: ignore[no-untyped-def]
    """Search chart by chart: all samples of a chart share one gathered list."""
    most = found.shape[1]
    spheres = _spheres(start, order, samples)
    capacity = _longest(start, neighbours) + most
    offsets = np.empty((3, capacity), dtype=np.float32)
    xs, ys, zs = offsets[0], offsets[1], offsets[2]
    rows, close = np.empty(capacity, dtype=np.int32), np.empty(capacity, dtype=np.int32)
    within = np.empty(capacity, dtype=np.uint8)
    for chart in range(len(neighbours)):
        members = order[start[chart] : start[chart + 1]]
        if len(members) == 0:
            continue
        widest = spheres[chart, 3] + radius[members].max()
        count = _gather(chart, widest, samples, neighbours, spheres, start, order, xs, ys, zs, rows)
        for member in range(len(members)):
            i = members[member]
            limit = np.float32(radius[i] * radius[i])
            _flag(xs[member], ys[member], zs[member], limit, count, xs, ys, zs, within)
            within[member] = 0
            # Without a branch, since the processor would mispredict it half of the time.
            filled = 0
            for at in range(count):
                close[filled] = rows[at]
                filled += within[at]
            for at in range(most):
                found[i, at] = close[at] if at < filled else -1
