# SPDX-License-Identifier: Apache-2.0
"""Regular grid of cubic cells, for searches within a fixed radius.

All points within the size of a cell from a place lie in the 27 cells around the place.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit

__all__ = ["Grid", "rows_within", "sort_into_grid", "thinned_grid"]

_CELLS = 1 << 20  # cells along an axis: three such numbers fit into an int64 key


@dataclass(frozen=True, eq=False)
class Grid:
    """Points sorted by cell.

    Attributes:
        size: side of a cell.
        low: ``(3,)`` float64, lowest corner.
        keys: ``(M,)`` int64 numbers of the cells of the points, ascending.
        order: ``(M,)`` int32 rows of the points; within a cell they ascend.
    """

    size: float
    low: NDArray[np.float64]
    keys: NDArray[np.int64]
    order: NDArray[np.int32]


def _cell_numbers(
    points: NDArray[np.float64], low: NDArray[np.float64], size: float
) -> NDArray[np.int64]:
    """Numbers ``(M,)`` of the cells of points ``(M, 3)``; x varies fastest.

    The grid has 2^20 cells along an axis; the last one holds all points beyond.
    """
    at = np.minimum(((points - low) / size).astype(np.int64), _CELLS - 2) + 1
    keys: NDArray[np.int64] = (at[:, 2] * _CELLS + at[:, 1]) * _CELLS + at[:, 0]
    return keys


def sort_into_grid(points: NDArray[np.float64], size: float) -> Grid:
    """Sort points ``(M, 3)`` into cells of the given size."""
    low = points.min(axis=0)
    keys = _cell_numbers(points, low, size)
    order = np.argsort(keys, kind="stable")
    return Grid(size, low, keys[order], order.astype(np.int32))


def thinned_grid(points: NDArray[np.float64], size: float, most: int) -> Grid:
    """Sort points ``(M, 3)`` into a grid from which crowded places are thinned.

    A fit to some hundred points is as good as one to many thousands, and takes less time.

    Args:
        points: ``(M, 3)``.
        size: side of a cell, and radius of the searches to come.
        most: points that are kept of each cell of half that side, at regular steps.

    Returns:
        The grid; ``order`` has the rows of the points that are kept.
    """
    fine = sort_into_grid(points, size / 2.0)
    starts = np.flatnonzero(np.append(True, fine.keys[1:] != fine.keys[:-1]))
    count = np.diff(np.append(starts, len(points)))
    if count.max() <= most:
        return sort_into_grid(points, size)
    step = np.repeat(-(-count // most), count)
    rank = np.arange(len(points)) - np.repeat(starts, count)
    kept = np.sort(fine.order[rank % step == 0])
    grid = sort_into_grid(points[kept], size)
    return Grid(size, grid.low, grid.keys, kept[grid.order])


@njit(cache=True, nogil=True)
def rows_within(x, y, z, points, low, size, keys, order, found):  # type: ignore[no-untyped-def]
    """Find the points within ``size`` of a place, in the order of their cells.

    If there are more than fit, every second one (or third, and so on) is taken: the first ones
    alone would all lie on one side.

    Args:
        x, y, z: the place.
        points: ``(M, 3)``.
        low, size, keys, order: see :class:`Grid`.
        found: ``(n,)`` int32, receives rows.

    Returns:
        The number of rows found.
    """
    total = _visit(x, y, z, points, low, size, keys, order, found, 1)
    if total <= len(found):
        return total
    step = -(-total // len(found))
    _visit(x, y, z, points, low, size, keys, order, found, step)
    return -(-total // step)


@njit(cache=True, nogil=True)
def _visit(x, y, z, points, low, size, keys, order, found, step):  # type: ignore[no-untyped-def]
    """Write every ``step``-th row within the radius as far as it fits; returns their number."""
    ix = min(max(int((x - low[0]) / size), 0), _CELLS - 2) + 1
    iy = min(max(int((y - low[1]) / size), 0), _CELLS - 2) + 1
    iz = min(max(int((z - low[2]) / size), 0), _CELLS - 2) + 1
    total = count = 0
    limit = size * size
    for dz in range(-1, 2):
        for dy in range(-1, 2):
            first = ((iz + dz) * _CELLS + iy + dy) * _CELLS + ix - 1
            at = np.searchsorted(keys, first)
            while at < len(keys) and keys[at] <= first + 2:
                row = order[at]
                a, b, c = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
                if a * a + b * b + c * c <= limit:
                    if total % step == 0 and count < len(found):
                        found[count] = row
                        count += 1
                    total += 1
                at += 1
    return total
