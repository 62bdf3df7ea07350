# SPDX-License-Identifier: Apache-2.0
"""Weighted sample elimination (Yuksel 2015): from many candidates to an even subset.

Every candidate weighs the more the closer its neighbours are; the heaviest is removed and its
neighbours lightened until the wanted number is left. Evenness is local: each candidate has its
own reach, so a sparse region is thinned as evenly as a dense one. Ties go to the lower row, so
the result depends on the input alone.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["eliminate", "reach_of_share"]
_LIMIT, _LIMIT_POWER = 0.65, 1.5


def reach_of_share(area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of neighbours in the hexagonal packing that gives each survivor ``area``."""
    reach: NDArray[np.float64] = np.sqrt(area * (2.0 / np.sqrt(3.0)))
    return reach


def eliminate(
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    reach: NDArray[np.float64],
    keep: int,
    burden: NDArray[np.float64] | None = None,
    counted: NDArray[np.bool_] | None = None,
) -> NDArray[np.int64]:
    """Rows of the survivors, in ascending order.

    Args:
        points: ``(C, 3)`` float64.
        neighbours: ``(C, k)`` int32 rows, ``-1`` where there is none; need not be mutual.
        reach: ``(C,)`` distance within which candidates crowd each other.
        keep: number of survivors among those counted, of which there are as many at least.
        burden: ``(C,)`` >= 0, added to a candidate's weight: untrusted ones go first. A factor
            would not do: an outlier has no neighbours, and its weight is next to nothing.
        counted: ``(C,)`` who is counted, ``None`` for all: the others, of a margin, are thinned
            alongside for as long as it takes.
    """
    counted = np.ones(len(points), dtype=np.bool_) if counted is None else counted
    there = int(np.count_nonzero(counted))
    if not 0 <= keep <= there:
        raise ValueError(f"keep must lie in 0..{there}, not {keep}")
    extra = np.zeros(len(points)) if burden is None else burden
    # Weight limiting (section 3.2 there): without it the closest pairs decide alone, and the
    # survivors' spacing varies by 11 % instead of 8 %.
    floor = _LIMIT * (1.0 - (keep / max(there, 1)) ** _LIMIT_POWER)
    alive = _run(points, neighbours, reach, extra, counted, there - keep, floor)
    return np.flatnonzero(alive)


@njit(cache=True, nogil=True)
def _weight(points, reach, floor, i, j):  # type: ignore[no-untyped-def]
    x = points[i, 0] - points[j, 0]
    y = points[i, 1] - points[j, 1]
    z = points[i, 2] - points[j, 2]
    far = max(reach[j], reach[i])
    share = 1.0 - max(np.sqrt(x * x + y * y + z * z) / far, floor)
    if share <= 0.0:
        return 0.0
    share *= share
    share *= share
    return share * share


@njit(cache=True, nogil=True)
def _heavier(key, a, b):  # type: ignore[no-untyped-def]
    return key[a] > key[b] or (key[a] == key[b] and a < b)


@njit(cache=True, nogil=True)
def _sift_down(heap, place, key, size, at):  # type: ignore[no-untyped-def]
    item = heap[at]
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and _heavier(key, heap[child + 1], heap[child]):
            child += 1
        if not _heavier(key, heap[child], item):
            break
        heap[at] = heap[child]
        place[heap[at]] = at
        at = child
    heap[at] = item
    place[item] = at


@njit(cache=True, nogil=True)
def _run(points, neighbours, reach, burden, counted, surplus, floor):  # type: ignore[no-untyped-def]
    count, k = neighbours.shape
    # Who lists me: a removal must lighten those, and lists are not always mutual.
    start = np.zeros(count + 1, dtype=np.int64)
    for i in range(count):
        for j in range(k):
            if neighbours[i, j] >= 0:
                start[neighbours[i, j] + 1] += 1
    for i in range(count):
        start[i + 1] += start[i]
    listed_by = np.empty(start[count], dtype=np.int32)
    fill = start[:-1].copy()
    key = burden.copy()
    for i in range(count):
        for j in range(k):
            other = neighbours[i, j]
            if other >= 0:
                listed_by[fill[other]] = i
                fill[other] += 1
                key[i] += _weight(points, reach, floor, i, other)
    heap = np.arange(count)
    place = np.arange(count)
    for at in range(count // 2 - 1, -1, -1):
        _sift_down(heap, place, key, count, at)
    alive = np.ones(count, dtype=np.bool_)
    size = count
    while surplus > 0:
        top = heap[0]
        alive[top] = False
        surplus -= counted[top]
        size -= 1
        heap[0] = heap[size]
        place[heap[0]] = 0
        if size:
            _sift_down(heap, place, key, size, 0)
        for at in range(start[top], start[top + 1]):
            other = listed_by[at]
            if alive[other]:
                key[other] -= _weight(points, reach, floor, other, top)
                _sift_down(heap, place, key, size, place[other])
    return alive
