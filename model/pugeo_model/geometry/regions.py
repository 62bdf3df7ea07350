# SPDX-License-Identifier: Apache-2.0
"""Compact regions of a cloud, of several sizes, and their principal axes."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.partition import divide
from pugeo_model.tuning import TUNING

__all__ = ["Regions", "nested_regions", "usual_regions"]

_SMALLEST = 48  # least number of points of the smallest regions
_SIZES = 5  # each four times the one before


class Regions:
    """Regions of one size.

    Attributes:
        of_point: ``(M,)`` int32 region of each point.
        count: ``(g,)`` points of each region.
        axis: ``(g, 3)`` unit normal of the plane through each.
        first, second, third: ``(g,)`` principal spreads (standard deviations), largest first.
    """

    def __init__(self, points: NDArray[np.float64], of_point: NDArray[np.int32]) -> None:
        self.of_point = of_point
        self.count = np.bincount(of_point)
        centred = points - self.means(points)[of_point]
        products = (centred[:, :, None] * centred[:, None, :]).reshape(-1, 9)
        values, vectors = np.linalg.eigh(self.means(products).reshape(-1, 3, 3))
        self.third, self.second, self.first = np.sqrt(np.maximum(values, 0.0)).T
        self.axis: NDArray[np.float64] = vectors[:, :, 0]

    @property
    def spreads_two_ways(self) -> NDArray[np.bool_]:
        """True where the points are no line, and enough to tell, ``(g,)``."""
        wide: NDArray[np.bool_] = self.second >= TUNING.surface_spread * self.first
        return wide & (self.count >= _SMALLEST)

    @property
    def side(self) -> NDArray[np.float64]:
        """Shorter side ``(g,)`` of the rectangle with the spreads of each region."""
        side: NDArray[np.float64] = np.sqrt(12.0) * self.second
        return side

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Means ``(g, c)`` of values ``(M, c)`` over each region."""
        sums = [np.bincount(self.of_point, column, len(self.count)) for column in values.T]
        means: NDArray[np.float64] = np.stack(sums, axis=1) / np.maximum(self.count, 1)[:, None]
        return means

    def medians(
        self, values: NDArray[np.float64], known: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Medians ``(g,)`` over each region of values ``(M,)``; infinite where none is known."""
        return self.quantiles(values, 0.5, known)

    def quantiles(
        self, values: NDArray[np.float64], share: float, known: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float64]:
        """Quantiles, otherwise as `medians`."""
        of_point = self.of_point if known is None else self.of_point[known]
        values = values if known is None else values[known]
        count = np.bincount(of_point, minlength=len(self.count))
        order = np.lexsort((values, of_point))
        quantiles = np.full(len(count), np.inf)
        some = count > 0
        rank = np.cumsum(count) - count + (share * count).astype(np.int64)
        quantiles[some] = values[order[rank[some]]]
        return quantiles


def nested_regions(points: NDArray[np.float64], *, start: int = 0) -> list[Regions]:
    """Divide a cloud into compact regions, each size into four of the one before.

    Args:
        points: ``(M, 3)``, at least one.
        start: number of the first size, 0 for regions of 48 to 95 points.

    Returns:
        Up to five sizes, from small to large; fewer if the cloud is smaller than the next region.
    """
    halvings = max(int(np.floor(np.log2(len(points) / _SMALLEST))), 0)
    smallest = np.empty(len(points), dtype=np.int32)
    # With a power of two as their number, four parts in a row are the halves of one half.
    for number, rows in enumerate(divide(points, 2**halvings)):
        smallest[rows] = number
    stop = min(start + _SIZES, halvings // 2 + 1)
    return [Regions(points, smallest >> (2 * size)) for size in range(start, stop)]


def usual_regions(regions: list[Regions]) -> Regions:
    """Regions of some 200 to 400 points: large enough for statistics, and small enough to be flat.

    Args:
        regions: of `nested_regions`.
    """
    return regions[min(1, len(regions) - 1)]
