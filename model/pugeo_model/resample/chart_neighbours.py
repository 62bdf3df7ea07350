# SPDX-License-Identifier: Apache-2.0
"""Neighbours among samples that know their chart: no tree, and density never matters.

A sample's neighbours belong to its own chart or to charts of that chart's nearest points, so a
handful of short lists is searched whatever the density there.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["chart_neighbours", "group_by_chart"]


def group_by_chart(
    owner: NDArray[np.int32], charts: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Samples sorted by chart: starts ``(charts + 1,)`` and sample rows ``(K,)``, ascending."""
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
    """Samples within radius of each sample, nearest charts searched first.

    Args:
        samples: ``(K, 3)``.
        owner: ``(K,)`` chart of each.
        neighbours: ``(M, k)`` charts near each chart, nearest first.
        radius: ``(K,)`` distance.
        most: longest list.

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
    """Centre and radius of what each chart holds, so that most charts are passed at one look."""
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
        # Rounding must not cost a neighbour, here or where distances are float32.
        spheres[chart, 3] = np.sqrt(most) * (1.0 + 1e-6)
    return spheres


@njit(cache=True, nogil=True, fastmath=True)
def _flag(x, y, z, limit, count, xs, ys, zs, within):  # type: ignore[no-untyped-def]
    """Which of the leading ``count`` samples are within the limit: a loop without a branch."""
    for at in range(count):
        a = xs[at] - x
        b = ys[at] - y
        c = zs[at] - z
        within[at] = a * a + b * b + c * c < limit


@njit(cache=True, nogil=True)
def _gather(chart, widest, samples, neighbours, spheres, start, order, xs, ys, zs, rows):  # type: ignore[no-untyped-def]
    """What the charts around one hold, its own samples first; returns how many.

    Places are float32 and relative to the chart: distances lose nothing that matters, and the
    processor takes sixteen at a time.
    """
    x, y, z = spheres[chart, 0], spheres[chart, 1], spheres[chart, 2]
    count = 0
    for near in range(-1, neighbours.shape[1]):
        other = chart if near < 0 else neighbours[chart, near]
        a, b, c = spheres[other, 0] - x, spheres[other, 1] - y, spheres[other, 2] - z
        far = max(spheres[other, 3] + widest, 0.0)
        if a * a + b * b + c * c > far * far:
            continue
        for at in range(start[other], start[other + 1]):
            j = order[at]
            a, b, c = samples[j, 0] - x, samples[j, 1] - y, samples[j, 2] - z
            rows[count], xs[count], ys[count], zs[count] = j, a, b, c
            # Without a branch: what is out of everyone's radius is written over.
            count += a * a + b * b + c * c <= widest * widest
    return count


@njit(cache=True, nogil=True)
def _longest(start, neighbours):  # type: ignore[no-untyped-def]
    """Most samples that a chart and those around it hold."""
    longest = 0
    for chart in range(len(neighbours)):
        total = start[chart + 1] - start[chart]
        for near in neighbours[chart]:
            total += start[near + 1] - start[near]
        longest = max(longest, total)
    return longest


@njit(cache=True, nogil=True)
def _chart_neighbours(samples, neighbours, radius, start, order, found):  # type: ignore[no-untyped-def]
    """All samples of a chart look at one list, gathered once."""
    most = found.shape[1]
    spheres = _spheres(start, order, samples)
    room = _longest(start, neighbours) + most
    places = np.empty((3, room), dtype=np.float32)
    xs, ys, zs = places[0], places[1], places[2]
    rows, close = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.int32)
    within = np.empty(room, dtype=np.uint8)
    for chart in range(len(neighbours)):
        own_samples = order[start[chart] : start[chart + 1]]
        if len(own_samples) == 0:
            continue
        widest = spheres[chart, 3] + radius[own_samples].max()
        count = _gather(chart, widest, samples, neighbours, spheres, start, order, xs, ys, zs, rows)
        for own in range(len(own_samples)):
            i = own_samples[own]
            limit = np.float32(radius[i] * radius[i])
            _flag(xs[own], ys[own], zs[own], limit, count, xs, ys, zs, within)
            within[own] = 0
            # Written without a branch, which would be guessed wrong for every other one.
            filled = 0
            for at in range(count):
                close[filled] = rows[at]
                filled += within[at]
            for at in range(most):
                found[i, at] = close[at] if at < filled else -1
