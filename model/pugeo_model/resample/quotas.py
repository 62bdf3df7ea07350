# SPDX-License-Identifier: Apache-2.0
"""Quotas: the numbers of output points of charts, relative to each other.

With density ``even`` the quota of a chart is its surface area; with density ``input`` it is the
number of input points that the chart represents.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.areas import neighbour_mean
from pugeo_model.tuning import TUNING

__all__ = ["area_quotas", "candidates_per_chart", "chosen_candidates", "count_quotas"]

_LEAST, _MOST = 1 / 16, 16.0  # times the usual number of points
_ROUNDS_OF_SHARES = 16  # each fills more charts; the last leaves at most a small rest


def area_quotas(spacing: NDArray[np.float32], usual_square: float) -> NDArray[np.float64]:
    """Quotas ``(M,)`` in proportion to areas, 1 for the usual area.

    Args:
        spacing: ``(M,)`` of the charts, see `bounded_spacing`.
        usual_square: squared spacing of the usual chart of the cloud.
    """
    square = spacing.astype(np.float64) ** 2
    largest = TUNING.largest_area
    return np.clip(square / usual_square, 1.0 / largest, largest)


def count_quotas(
    count: NDArray[np.float64], neighbours: NDArray[np.int32], mean: float
) -> NDArray[np.float64]:
    """Quotas ``(M,)`` in proportion to the number of represented points, 1 for their mean.

    Args:
        count: ``(M,)`` points that each chart represents.
        neighbours: ``(M, k)`` charts near each.
        mean: of the counts of the whole cloud.
    """
    smooth: NDArray[np.float64] = neighbour_mean(count, neighbours, TUNING.quota_rounds) / mean
    return np.clip(smooth, _LEAST, _MOST)


def candidates_per_chart(candidates: int, quotas: NDArray[np.float64]) -> int:
    """Return the number of candidates of each chart that suffices for almost all quotas.

    Args:
        candidates: number for a quota of 1.
        quotas: ``(charted,)``.
    """
    largest = min(max(float(np.quantile(quotas, 0.98)), 1.0), TUNING.most_candidates)
    return math.ceil(candidates * largest)


def chosen_candidates(
    quotas: NDArray[np.float64], total: float, wanted: int, candidates: int
) -> NDArray[np.int64]:
    """Choose candidates of each chart in proportion to its quota.

    If all charts proposed the same number, candidates of dense regions would be too close for the
    elimination, which compares each with few others.

    Args:
        quotas: ``(charted,)``.
        total: sum of the quotas of the core.
        wanted: output points of the core.
        candidates: candidates of each chart.

    Returns:
        Indices among ``charted * candidates``, ascending.
    """
    share = _filled(quotas * (TUNING.quota_oversampling * wanted / total), candidates, wanted)
    # Fractions are carried over to the next chart, which is nearby.
    ends = np.floor(np.cumsum(share)).astype(np.int64)
    count = np.minimum(np.diff(ends, prepend=0), candidates)
    chart = np.repeat(np.arange(len(count)), count)
    turn = np.arange(len(chart)) - np.repeat(np.cumsum(count) - count, count)
    chosen: NDArray[np.int64] = chart * candidates + turn * candidates // count[chart]
    return chosen


def _filled(share: NDArray[np.float64], most: int, wanted: int) -> NDArray[np.float64]:
    """Raise the shares of charts until charts with too large a share are made up for.

    A chart that stands for many input points may have a share beyond its candidates.
    """
    least = TUNING.least_oversampling * wanted
    for _ in range(_ROUNDS_OF_SHARES):
        full = share >= most
        lacking = least - np.minimum(share, most).sum()
        if lacking <= 0.0 or full.all():
            break
        share = np.where(full, share, share * (1.0 + lacking / share[~full].sum()))
    return share
