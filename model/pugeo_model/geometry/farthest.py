# SPDX-License-Identifier: Apache-2.0
"""Farthest-point sampling, exact, in buckets of neighbouring points.

After each choice only those buckets are visited whose box the chosen point may be nearer to than
all points chosen before; the others cannot change. The result is that of the plain algorithm,
which takes ``K * n`` distances.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.partition import partition
from pugeo_model.kernel_compiler import njit

__all__ = ["farthest_points"]

_BUCKET = 64  # points: of 32, 64 and 128 the fastest for 60,000 candidates


def farthest_points(
    points: NDArray[np.float64], count: int, given: NDArray[np.float64] | None = None
) -> NDArray[np.int64]:
    """Rows of ``count`` points, each the farthest from all before it.

    The first is the one farthest from the mean, so that the result depends on the set alone; ties
    go to the bucket, then the row, that comes first.

    Args:
        points: ``(n, 3)`` float64, finite.
        count: from 0 to ``n``.
        given: ``(g, 3)`` points that count as chosen before the first.

    Returns:
        ``(count,)`` int64 rows in the order of choice.
    """
    if not 0 <= count <= len(points):
        raise ValueError(f"count must lie in 0..{len(points)}, not {count}")
    if count == 0:
        return np.empty(0, dtype=np.int64)
    parts = partition(points, _BUCKET)
    order = np.concatenate(parts).astype(np.int64)
    ends = np.cumsum([0, *map(len, parts)])
    sorted_points = np.ascontiguousarray(points[order], dtype=np.float64)
    low = np.minimum.reduceat(sorted_points, ends[:-1])
    high = np.maximum.reduceat(sorted_points, ends[:-1])
    distance = np.full(len(points), np.inf)
    best = np.full(len(parts), np.inf)
    at = ends[:-1].copy()
    chosen = np.empty(count, dtype=np.int64)
    before = np.empty((0, 3)) if given is None else np.ascontiguousarray(given, dtype=np.float64)
    if not len(before):
        first = int(np.linalg.norm(sorted_points - sorted_points.mean(axis=0), axis=1).argmax())
        bucket = int(np.searchsorted(ends, first, side="right")) - 1
        # The only bucket without a bound lies highest, and is chosen from first.
        best[:] = np.finfo(np.float64).max
        best[bucket], at[bucket] = np.inf, first
    _choose(sorted_points, ends, low, high, distance, best, at, before, chosen)
    return order[chosen]


@njit(cache=True, nogil=True)
def _visit(points, ends, low, high, distance, best, at, x, y, z):  # type: ignore[no-untyped-def]
    """Update the squared distances to the chosen points after (x, y, z) was added."""
    for bucket in range(len(best)):
        dx = max(low[bucket, 0] - x, 0.0, x - high[bucket, 0])
        dy = max(low[bucket, 1] - y, 0.0, y - high[bucket, 1])
        dz = max(low[bucket, 2] - z, 0.0, z - high[bucket, 2])
        if dx * dx + dy * dy + dz * dz >= best[bucket]:
            continue
        most, where = -1.0, ends[bucket]
        for i in range(ends[bucket], ends[bucket + 1]):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            apart = min(distance[i], dx * dx + dy * dy + dz * dz)
            distance[i] = apart
            if apart > most:
                most, where = apart, i
        best[bucket], at[bucket] = most, where


@njit(cache=True, nogil=True)
def _choose(points, ends, low, high, distance, best, at, given, chosen):  # type: ignore[no-untyped-def]
    for g in range(len(given)):
        _visit(points, ends, low, high, distance, best, at, given[g, 0], given[g, 1], given[g, 2])
    for turn in range(len(chosen)):
        bucket = np.argmax(best)
        row = at[bucket]
        chosen[turn] = row
        x, y, z = points[row]
        _visit(points, ends, low, high, distance, best, at, x, y, z)
        # Exclude this row from later choices, even if it has duplicates.
        distance[row] = -1.0
        at[bucket] = ends[bucket] + np.argmax(distance[ends[bucket] : ends[bucket + 1]])
        best[bucket] = distance[at[bucket]]
