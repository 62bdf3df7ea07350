# SPDX-License-Identifier: Apache-2.0
"""Selection of the output points: sample elimination among candidates, then repulsion."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.areas import neighbour_mean
from pugeo_model.resample.chart_neighbours import chart_neighbours
from pugeo_model.resample.elimination import eliminate
from pugeo_model.resample.repulsion import repel
from pugeo_model.tuning import TUNING

__all__ = ["select", "spread_evenly"]

_GRID = 2.0**20  # cells per unit of length: finer than any sample, coarser than rounding errors
_MULTIPLIER = 0xBF58476D1CE4E5B9  # of splitmix64 (Steele, Lea and Flood 2014)
_PINNED = -1e9  # penalty of points that must survive, far below any weight
_UNWANTED = 1e6  # penalty of points that survive only if there are too few others


def select(
    candidates: NDArray[np.float64],
    normals: NDArray[np.float32],
    error: NDArray[np.float32],
    owner: NDArray[np.int32],
    wanted: int,
    radius: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    seed: int,
    pinned: tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]] | None = None,
    core: NDArray[np.bool_] | None = None,
    charted: int | None = None,
    quotas: NDArray[np.float64] | None = None,
    unwanted: NDArray[np.bool_] | None = None,
    *,
    keep_all: bool = False,
    most_error: float = TUNING.usual_error_most,
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Select exactly the wanted number of candidates, then move them to an even spacing.

    Args:
        candidates: ``(C, 3)`` float64, on the surface.
        normals: ``(C, 3)`` float32, unit length.
        error: ``(C,)`` float32 predicted error, in spacings.
        owner: ``(C,)`` int32 nearest chart.
        wanted: number of points of the core's charts, at most the number of their candidates.
        radius: ``(M,)`` packing radius of each chart, see `chart_radii`.
        neighbours: ``(M, k)`` charts near each chart.
        seed: each seed gives another sample.
        pinned: input points ``(n, 3)``, their normals ``(n, 3)`` and charts ``(n,)``, if these
            may be selected; they are not moved.
        core: ``(M,)`` charts whose points are wanted, by default all; the others are a margin
            that makes the border of the core even.
        charted: number of leading charts that have candidates, by default all.
        quotas: ``(M,)`` relative numbers of output points of charts, by default equal.
        unwanted: ``(C,)`` candidates that are selected only if there are too few others.
        keep_all: select all pinned points of the core.
        most_error: candidates that expect more than this times the error around have a penalty at
            every ratio.

    Returns:
        Of the core: the rows of ``pinned`` that are selected, ascending int32; the other points
        ``(K, 3)`` float64; and the owner of each of these, int32.
    """
    core = np.ones(len(radius), dtype=np.bool_) if core is None else core
    near = np.ascontiguousarray(neighbours[:, : TUNING.searched_charts])
    has_chart = np.arange(len(radius)) < (len(radius) if charted is None else charted)
    limit = float(
        TUNING.usual_error * (wanted / np.count_nonzero(core)) ** TUNING.usual_error_power
    )
    limit = min(max(limit, TUNING.usual_error_least), most_error)
    penalty = _error_penalty(error.astype(np.float64), owner, near, has_chart, limit)
    penalty += TUNING.seed_penalty * _random(candidates, seed)
    if unwanted is not None:
        penalty[unwanted] += _UNWANTED
    pins = 0
    if pinned is not None:
        pins = len(pinned[0])
        owner = np.concatenate([pinned[2], owner])
        candidates = np.concatenate([pinned[0], candidates])
        normals = np.concatenate([pinned[1], normals])
        penalty = np.concatenate([np.full(pins, _PINNED if keep_all else 0.0), penalty])

    def level(alive: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Raise the weights where penalties or thin walls left too many candidates."""
        left = np.bincount(owner[alive], minlength=len(near)).astype(np.float64)
        if quotas is not None:
            left /= quotas
        mean = _masked_mean(left, has_chart, neighbours, TUNING.levelling_rounds)
        density = np.clip(mean / left[core].mean(), *TUNING.levelling_bounds)
        factor: NDArray[np.float64] = density[owner] ** TUNING.levelling_power
        return factor

    kept = eliminate(
        candidates,
        # The lists are large and have no name, so that they are freed early.
        chart_neighbours(candidates, owner, near, radius[owner], TUNING.elimination_neighbours),
        radius[owner],
        wanted,
        penalty,
        core[owner],
        level,
    )
    points, owner = candidates[kept], owner[kept]
    kept_pins = int(np.searchsorted(kept, pins))
    push = radius[owner]
    push[:kept_pins] = 0.0  # pinned points push others and do not move
    points = _repel(points, normals[kept], owner, near, radius, push, TUNING.repulsion_rounds)
    in_core = core[owner]
    kept_inputs = kept[:kept_pins][in_core[:kept_pins]].astype(np.int32)
    in_core[:kept_pins] = False
    return kept_inputs, points[in_core], owner[in_core]


def spread_evenly(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    radius: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    core: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Apply one round of repulsion to projected points.

    The charts of a noisy input differ, so that projection disturbs the even spacing. Points next
    to a margin are not moved, since the points of the other tile that would push back are absent.

    Args:
        points: ``(K, 3)`` float64, of the core's charts.
        normals: ``(K, 3)`` float32, unit length.
        owner: ``(K,)`` int32 nearest chart.
        radius: ``(M,)`` packing radius of each chart, see `chart_radii`.
        neighbours: ``(M, k)`` charts near each chart.
        core: ``(M,)`` bool, charts of the core.

    Returns:
        ``(K, 3)`` float64.
    """
    near = np.ascontiguousarray(neighbours[:, : TUNING.searched_charts])
    push = np.where(core[near].all(axis=1), radius, 0.0)[owner]
    return _repel(points, normals, owner, near, radius, push, 1)


def _repel(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    near: NDArray[np.int32],
    radius: NDArray[np.float64],
    push: NDArray[np.float64],
    rounds: int,
) -> NDArray[np.float64]:
    """Find neighbours and repel points ``(K, 3)``.

    Args:
        radius: ``(M,)`` packing radius of each chart, for the search.
        push: ``(K,)`` packing radius of each point, 0 for fixed points.
    """
    search = TUNING.repulsion_search * radius[owner]
    lists = chart_neighbours(points, owner, near, search, TUNING.repulsion_neighbours)
    return repel(points, normals, lists, push, rounds)


def _random(points: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Random numbers in 0..1, ``(C,)``: a hash of position and seed (mixing step of splitmix64).

    They do not depend on rows, so that a candidate has the same number in all tiles.
    """
    hashes = np.full(len(points), seed, dtype=np.uint64)
    for column in np.rint(points.T * _GRID).astype(np.int64).view(np.uint64):
        hashes ^= column
        hashes *= np.uint64(_MULTIPLIER)
        hashes ^= hashes >> np.uint64(29)
    return hashes / 2.0**64


def _masked_mean(
    values: NDArray[np.float64],
    valid: NDArray[np.bool_],
    neighbours: NDArray[np.int32],
    rounds: int,
) -> NDArray[np.float64]:
    """Repeated means over the valid neighbours, ``(M,)``; see `neighbour_mean`."""
    sums: NDArray[np.float64] = neighbour_mean(np.where(valid, values, 0.0), neighbours, rounds)
    if not valid.all():
        sums /= np.maximum(neighbour_mean(valid.astype(np.float64), neighbours, rounds), 1e-12)
    return sums


def _error_penalty(
    error: NDArray[np.float64],
    owner: NDArray[np.int32],
    near: NDArray[np.int32],
    has_chart: NDArray[np.bool_],
    limit: float,
) -> NDArray[np.float64]:
    """Penalty ``(C,)`` of candidates with more than ``limit`` times the mean error around them.

    The comparison is local: where all errors are large, as along an edge, a penalty on all
    candidates would leave a hole. The neighbourhood is wide: at the rim of a fin all errors are
    large, but only some candidates lie beyond the rim.
    """
    charts = len(near)
    count = np.maximum(np.bincount(owner, minlength=charts), 1)
    chart_error = np.bincount(owner, error, charts) / count
    mean = _masked_mean(chart_error, has_chart, near, TUNING.error_rounds)
    excess = error / np.maximum(mean[owner], 1e-12) - limit
    penalty: NDArray[np.float64] = TUNING.error_penalty * np.maximum(excess, 0.0)
    return penalty
