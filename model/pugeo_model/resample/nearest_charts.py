# SPDX-License-Identifier: Apache-2.0
"""The charts nearest to a point."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["nearest_charts"]


def nearest_charts(
    queries: NDArray[np.float64],
    owner: NDArray[np.int32],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    count: int,
    charted: int | None = None,
) -> NDArray[np.int32]:
    """Find the ``count`` charts nearest to each query point.

    Only the query's own chart and the charts next to that one are searched.

    Args:
        queries: ``(K, 3)`` float64.
        owner: ``(K,)`` int32 own chart of each query.
        points: ``(M, 3)`` float64, the points of the charts.
        neighbours: ``(M, k)`` points near each point.
        count: number of charts; missing ones are replaced by the own chart.
        charted: number of leading points that have charts, by default all.

    Returns:
        ``(K, count)`` int32, nearest first.
    """
    found = np.empty((len(queries), count), dtype=np.int32)
    charted = len(points) if charted is None else charted
    _nearest_charts(queries, owner, points, neighbours[:, : TUNING.searched_charts], charted, found)
    return found


@njit(cache=True, nogil=True)
def _nearest_charts(queries, owner, points, neighbours, charted, found):  # type: ignore[no-untyped-def]
    """Search the charts around each query; writes ``found``."""
    count, k = found.shape[1], neighbours.shape[1]
    best = np.empty(count)
    charts = np.empty(k + 1, dtype=np.int32)
    around = np.empty((3, k + 1))
    squared = np.empty(k + 1)
    before = -1
    for i in range(len(queries)):
        if owner[i] != before:
            # Queries mostly come chart by chart, so the points around a chart are gathered once.
            before = owner[i]
            charts[0], charts[1:] = before, neighbours[before]
            for near in range(k + 1):
                for a in range(3):
                    around[a, near] = points[charts[near], a]
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        for near in range(k + 1):
            a = x - around[0, near]
            b = y - around[1, near]
            c = z - around[2, near]
            squared[near] = a * a + b * b + c * c
        best[:] = np.inf
        found[i, :] = before
        for near in range(k + 1):
            d = squared[near]
            if d >= best[count - 1] or charts[near] >= charted:
                continue
            at = count - 1
            while at > 0 and d < best[at - 1]:
                best[at] = best[at - 1]
                found[i, at] = found[i, at - 1]
                at -= 1
            best[at] = d
            found[i, at] = charts[near]
