# SPDX-License-Identifier: Apache-2.0
"""Wild values: single points so far away that the rest would shrink to a spot.

A wrong digit, an uninitialised record or the no-data value of a raster is no part of the scan.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["wild_points"]

_FAR = 100.0  # extents of the other points from them to a wild point
_FEW = 0.001  # share of points that may be wild
_FEWEST = 32  # points that may be wild in any cloud of some hundred points
_FEWEST_SHARE = 0.125  # share of points that may be wild in a smaller one
_SMALLEST = 24  # points of a cloud below which none is wild: there is no bulk to compare with
_NO_DATA = 1.0  # extents of the other points from them to a no-data value
_SMALLEST_NO_DATA = 9999.0  # in size
_NO_DATA_SHARE = 0.5  # share of points that may have any such value
_KNOWN_NO_DATA = (999.0, 9999.0, 99999.0, 32767.0, 32768.0)  # sizes that rasters use
_HUGE_NO_DATA = 1e30  # likewise, as the largest float32 number is
_KNOWN_SHARE = 0.95  # share of points that may have a value that rasters use
_MOST_NO_DATA = 4  # no-data values of one axis


def wild_points(points: NDArray[Any]) -> NDArray[np.bool_]:
    """Find the points that are far away from all others.

    Points are wild if a gap of 100 times the longest side of the other points separates them along
    an axis, and if they are few. More points may be wild if all have the same value in one axis,
    as no-data values of a raster have.

    Args:
        points: ``(M, 3)``, finite.

    Returns:
        ``(M,)`` bool.
    """
    none = np.zeros(len(points), np.bool_)
    if len(points) < _SMALLEST:
        return none
    few = max(min(_FEWEST, int(_FEWEST_SHARE * len(points))), int(_FEW * len(points)))
    # Halved, since differences of huge values overflow.
    halves = points.astype(np.float64) / 2.0
    no_data = np.logical_or.reduce([_no_data(column) for column in halves.T], initial=False)
    if np.any(no_data):
        far = _far_away(halves, few, no_data)
        far |= no_data
        return far
    return _far_away(halves, few, none)


def _far_away(
    halves: NDArray[np.float64], few: int, left_out: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Points beyond a wide gap around the bulk of the points, ``(M,)``."""
    rest = halves[~left_out]
    if len(rest) <= 2 * few:
        return np.zeros(len(halves), np.bool_)
    low, high = np.partition(rest, (few, len(rest) - 1 - few), axis=0)[[few, -1 - few]]
    extent = float((high - low).max())
    wild = np.zeros(len(halves), np.bool_)
    if extent == 0.0:
        return wild
    for column, start, stop in zip(halves.T, low, high, strict=True):
        below = -_edge(-column[column < start], -start, extent)
        above = _edge(column[column > stop], stop, extent)
        wild |= (column < below) | (column > above)
    return wild & ~left_out


def _edge(values: NDArray[np.float64], start: float, extent: float) -> float:
    """Largest value that is reached from ``start`` without a wide gap."""
    edge = start
    for value in np.sort(values):
        if value - edge > _FAR * max(extent, edge - start):
            break
        edge = float(value)
    return edge


def _no_data(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Points that share extreme values far from all others, ``(M,)``.

    Args:
        values: halved coordinates of one axis.
    """
    found = np.zeros(len(values), np.bool_)
    others = values
    for _ in range(_MOST_NO_DATA):
        value = _no_data_value(others, len(values))
        if value is None:
            break
        found |= values == value
        others = values[~found]
    return found


def _no_data_value(values: NDArray[np.float64], count: int) -> float | None:
    """An extreme value that some of the points share, far from all others; ``None`` without one.

    Args:
        values: halved coordinates of one axis.
        count: number of all points.
    """
    if not len(values):
        return None
    for extreme in (float(values.min()), float(values.max())):
        size = 2.0 * abs(extreme)
        known = size in _KNOWN_NO_DATA or size > _HUGE_NO_DATA
        if size < _SMALLEST_NO_DATA and not known:
            continue
        others = values[values != extreme]
        most = (_KNOWN_SHARE if known else _NO_DATA_SHARE) * count
        if not len(others) or not 2 <= len(values) - len(others) <= most:
            continue
        low, high = float(others.min()), float(others.max())
        gap = max(low - extreme, extreme - high)
        if gap > _NO_DATA * (high - low) and gap > 0.5 * abs(extreme):
            return extreme
    return None
