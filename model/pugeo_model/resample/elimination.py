# SPDX-License-Identifier: Apache-2.0
"""Weighted sample elimination (Yuksel 2015): an even subset of many candidates.

A candidate i has the weight ``w_i = sum_j (1 - max(d_ij / r, floor))^8`` over its neighbours j,
where d is the distance and r the larger packing radius of the two. The heaviest candidate is
removed and its contribution subtracted from its neighbours, until the requested number is left.
Each candidate has its own radius, so that sparse and dense regions are thinned equally. Of equal
weights the lower row is removed first, so that the result is deterministic.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["chart_radii", "eliminate", "packing_radius"]

_BUCKET_BITS = 14  # low bits of a float32 that its bucket ignores: 512 buckets per octave


def packing_radius(area: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of neighbours in a hexagonal packing with ``area`` per point.

    Args:
        area: any shape, squared length units.
    """
    radius: NDArray[np.float64] = np.sqrt(area * (2.0 / np.sqrt(3.0)))
    return radius


def chart_radii(
    area: NDArray[np.float64],
    quotas: NDArray[np.float64] | None,
    core: NDArray[np.bool_],
    wanted: int,
) -> NDArray[np.float64]:
    """Return the packing radius of the output points around each chart, ``(M,)``.

    Args:
        area: ``(M,)`` surface area of each chart.
        quotas: ``(M,)`` relative numbers of output points; ``None`` if all are equal.
        core: ``(M,)`` charts of the core.
        wanted: number of output points of the core.
    """
    if quotas is None:
        return packing_radius(area * (np.count_nonzero(core) / wanted))
    return packing_radius(area / quotas * (float(quotas[core].sum()) / wanted))


def eliminate(
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    radius: NDArray[np.float64],
    keep: int,
    penalty: NDArray[np.float64] | None = None,
    counted: NDArray[np.bool_] | None = None,
    level: Callable[[NDArray[np.bool_]], NDArray[np.float64]] | None = None,
) -> NDArray[np.int64]:
    """Select an even subset.

    Args:
        points: ``(C, 3)`` float64.
        neighbours: ``(C, k)`` int32 rows, then ``-1``. Lists are symmetric unless they are full;
            a missing entry only means that a weight is not reduced.
        radius: ``(C,)`` packing radius of each candidate.
        keep: number of survivors among the counted candidates.
        penalty: ``(C,)`` >= 0, added to the weights, so that unreliable candidates are removed
            first. It is no factor, since an outlier has no neighbours and thus hardly any weight.
        counted: ``(C,)`` candidates that count, by default all; those of a margin do not, but are
            thinned at the same rate.
        level: called once near the end with the remaining candidates ``(C,)``; returns factors
            ``(C,)`` > 0 of the weights from then on. Large factors remove more candidates.

    Returns:
        Rows of the survivors, ascending.

    Raises:
        ValueError: there are fewer than ``keep`` counted candidates.
    """
    counted = np.ones(len(points), dtype=np.bool_) if counted is None else counted
    remaining = int(np.count_nonzero(counted))
    if not 0 <= keep <= remaining:
        raise ValueError(f"keep must lie in 0..{remaining}, not {keep}")
    extra = np.zeros(len(points)) if penalty is None else penalty
    # Weight limiting (section 3.2 there), so that the closest pairs do not decide alone.
    floor = TUNING.weight_limit * (1.0 - (keep / max(remaining, 1)) ** TUNING.weight_limit_power)
    key = extra.astype(np.float64)
    weights = _weigh(points, neighbours, radius, floor, key)
    alive, factor = np.ones(len(points), dtype=np.bool_), np.ones(len(points))
    levelled = min(int(TUNING.levelling_at * keep), remaining)
    if level is not None and levelled > keep:
        _thin(neighbours, weights, counted, remaining - levelled, key, alive, factor)
        factor = level(alive)
        key *= factor
        remaining = levelled
    _thin(neighbours, weights, counted, remaining - keep, key, alive, factor)
    return np.flatnonzero(alive)


@njit(cache=True, nogil=True)
def _sift_down(keys, rows, size, at):  # type: ignore[no-untyped-def]
    """Restore the order of a binary max-heap below ``at``."""
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
    """Bucket of a key: monotonic in the key, with a width proportional to it."""
    bits = np.float32(max(key, 0.0)).view(np.int32) & np.int32(0x7FFFFFFF)
    return bits >> np.int32(_BUCKET_BITS)


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(points, neighbours, radius, floor, key):  # type: ignore[no-untyped-def]
    """Weights of the neighbours of each candidate ``(C, k)``; their sums are added to ``key``."""
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
            weight = 1.0 - max(near, floor)
            weight = max(weight, 0.0)
            weight *= weight
            weight *= weight
            weights[i, at] = weight * weight
            total += weights[i, at]
        key[i] += total
    return weights


@njit(cache=True, nogil=True)
def _fill_buckets(key, alive):  # type: ignore[no-untyped-def]
    """Linked lists of the candidates of each bucket: heads, and successors of candidates."""
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
    """Insert a candidate into the list of its bucket."""
    bucket = _bucket(key[row])
    after[row] = first[bucket]
    first[bucket] = row


@njit(cache=True, nogil=True)
def _heapify_bucket(top, first, after, key, keys, rows):  # type: ignore[no-untyped-def]
    """Make a heap of the candidates that still belong into bucket ``top``; returns its size."""
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
    """Remove the heaviest candidates until ``surplus`` of those counted are removed.

    Keys only decrease, so the heaviest candidates are found bucket by bucket, and a candidate
    whose key decreased is moved when it is reached. A heap of all candidates that is updated at
    each change takes twice as long.
    """
    first, after = _fill_buckets(key, alive)
    keys, rows = np.empty(len(key)), np.empty(len(key), dtype=np.int32)
    top, size = len(first), 0
    while surplus > 0:
        if size == 0:
            top -= 1
            size = _heapify_bucket(top, first, after, key, keys, rows)
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
