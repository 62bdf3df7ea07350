# SPDX-License-Identifier: Apache-2.0
"""Weighted sample elimination (Yuksel 2015): from many candidates to an even subset.

Every candidate weighs the more the closer its neighbours are; the heaviest is removed and its
neighbours lightened until the wanted number is left. Evenness is local: each candidate has its
own radius, so a sparse region is thinned as evenly as a dense one. Ties go to the lower row, so
the result depends on the input alone.
"""

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.tuning import TUNING

__all__ = ["eliminate", "packing_radius"]

_BUCKET_BITS = 14  # of a float32 that do not matter for its bucket: 512 buckets an octave


def packing_radius(area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of neighbours in the hexagonal packing that gives each survivor ``area``."""
    radius: NDArray[np.float64] = np.sqrt(area * (2.0 / np.sqrt(3.0)))
    return radius


def eliminate(
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    radius: NDArray[np.float64],
    keep: int,
    penalty: NDArray[np.float64] | None = None,
    counted: NDArray[np.bool_] | None = None,
    level: Callable[[NDArray[np.bool_]], NDArray[np.float64]] | None = None,
) -> NDArray[np.int64]:
    """Rows of the survivors, in ascending order.

    Args:
        points: ``(C, 3)`` float64.
        neighbours: ``(C, k)`` int32 rows, then ``-1``. Mutual, but for lists that are full: who is
            on a list and does not have it on its own is not lightened when it goes.
        radius: ``(C,)`` distance within which candidates crowd each other.
        keep: number of survivors among those counted, of which there are as many at least.
        penalty: ``(C,)`` >= 0, added to a candidate's weight: untrusted ones go first. A factor
            would not do: an outlier has no neighbours, and its weight is next to nothing.
        counted: ``(C,)`` who is counted, ``None`` for all: the others, of a margin, are thinned
            alongside for as long as it takes.
        level: asked once, near the end, with ``(C,)`` who is left: factors ``(C,)`` > 0 of all
            weights from then on. Where they are large, more go.
    """
    counted = np.ones(len(points), dtype=np.bool_) if counted is None else counted
    there = int(np.count_nonzero(counted))
    if not 0 <= keep <= there:
        raise ValueError(f"keep must lie in 0..{there}, not {keep}")
    extra = np.zeros(len(points)) if penalty is None else penalty
    # Weight limiting (section 3.2 there): without it the closest pairs decide alone, and the
    # survivors' spacing varies by 11 % instead of 8 %.
    floor = TUNING.weight_limit * (1.0 - (keep / max(there, 1)) ** TUNING.weight_limit_power)
    key = extra.astype(np.float64)
    weights = _weigh(points, neighbours, radius, floor, key)
    alive, factor = np.ones(len(points), dtype=np.bool_), np.ones(len(points))
    nearly = min(int(TUNING.levelling_at * keep), there)
    if level is not None and nearly > keep:
        _thin(neighbours, weights, counted, there - nearly, key, alive, factor)
        factor = level(alive)
        key *= factor
        there = nearly
    _thin(neighbours, weights, counted, there - keep, key, alive, factor)
    return np.flatnonzero(alive)


@njit(cache=True, nogil=True)
def _sift_down(keys, rows, size, at):  # type: ignore[no-untyped-def]
    key, row = keys[at], rows[at]
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        other = child + 1
        if other < size and (
            keys[other] > keys[child] or (keys[other] == keys[child] and rows[other] < rows[child])
        ):
            child = other
        if keys[child] < key or (keys[child] == key and rows[child] > row):
            break
        keys[at], rows[at] = keys[child], rows[child]
        at = child
    keys[at], rows[at] = key, row


@njit(cache=True, nogil=True)
def _bucket(key):  # type: ignore[no-untyped-def]
    """Number of the bucket of a key: never lower for a heavier key, and finer for light ones."""
    bits = np.float32(max(key, 0.0)).view(np.int32) & np.int32(0x7FFFFFFF)
    return bits >> np.int32(_BUCKET_BITS)


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(points, neighbours, radius, floor, key):  # type: ignore[no-untyped-def]
    """What each neighbour weighs, ``(C, k)``; all of it is added to the keys."""
    weights = np.empty(neighbours.shape, dtype=np.float32)
    inverse = 1.0 / radius
    for i in range(len(neighbours)):
        total = 0.0
        for at in range(neighbours.shape[1]):
            j = neighbours[i, at]
            if j < 0:
                break
            x = points[i, 0] - points[j, 0]
            y = points[i, 1] - points[j, 1]
            z = points[i, 2] - points[j, 2]
            near = np.sqrt(x * x + y * y + z * z) * min(inverse[j], inverse[i])
            share = 1.0 - max(near, floor)
            share = max(share, 0.0)
            share *= share
            share *= share
            weights[i, at] = share * share
            total += weights[i, at]
        key[i] += total
    return weights


@njit(cache=True, nogil=True)
def _fill_buckets(key, alive):  # type: ignore[no-untyped-def]
    """Linked lists of candidates: the first of each bucket, and the next after each candidate."""
    top = 0
    for i in range(len(key)):
        if alive[i]:
            top = max(top, _bucket(key[i]))
    first = np.full(top + 1, -1, dtype=np.int32)
    after = np.empty(len(key), dtype=np.int32)
    for i in range(len(key) - 1, -1, -1):
        if alive[i]:
            _put(first, after, key, i)
    return first, after


@njit(cache=True, nogil=True)
def _put(first, after, key, row):  # type: ignore[no-untyped-def]
    bucket = _bucket(key[row])
    after[row] = first[bucket]
    first[bucket] = row


@njit(cache=True, nogil=True)
def _open(top, first, after, key, keys, rows):  # type: ignore[no-untyped-def]
    """Make a heap of what still belongs into the bucket ``top``; returns its size."""
    size = 0
    row = first[top]
    while row >= 0:
        following = after[row]
        if _bucket(key[row]) == top:
            keys[size], rows[size] = key[row], row
            size += 1
        else:
            _put(first, after, key, row)
        row = following
    for at in range(size // 2 - 1, -1, -1):
        _sift_down(keys, rows, size, at)
    return size


@njit(cache=True, nogil=True)
def _thin(neighbours, weights, counted, surplus, key, alive, factor):  # type: ignore[no-untyped-def]
    """Remove the heaviest until there is no surplus.

    Keys only ever fall, so the heaviest are found bucket by bucket, and a candidate that has
    become lighter is put where it belongs only when it is met: one heap of all, kept in order at
    every change, takes twice as long.
    """
    first, after = _fill_buckets(key, alive)
    keys, rows = np.empty(len(key)), np.empty(len(key), dtype=np.int32)
    top, size = len(first), 0
    while surplus > 0:
        if size == 0:
            top -= 1
            size = _open(top, first, after, key, keys, rows)
            continue
        row = rows[0]
        belongs = _bucket(key[row]) == top
        if belongs and key[row] < keys[0]:
            keys[0] = key[row]
            _sift_down(keys, rows, size, 0)
            continue
        size -= 1
        keys[0], rows[0] = keys[size], rows[size]
        _sift_down(keys, rows, size, 0)
        if not belongs:
            _put(first, after, key, row)
            continue
        alive[row] = False
        surplus -= counted[row]
        for at in range(neighbours.shape[1]):
            other = neighbours[row, at]
            if other < 0:
                break
            key[other] -= factor[other] * weights[row, at]
