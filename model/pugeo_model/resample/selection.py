# SPDX-License-Identifier: Apache-2.0
"""The merge: landed candidates to exactly the number wanted, and the charts nearest to each."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.geometry.areas import neighbour_mean
from pugeo_model.resample.chart_neighbours import chart_neighbours
from pugeo_model.resample.elimination import eliminate, packing_radius
from pugeo_model.resample.repulsion import repel
from pugeo_model.tuning import TUNING

__all__ = ["nearest_charts", "select", "spread_evenly"]

_NEAR_CHARTS = 12  # charts searched around a sample
_CROWD = 16  # longest neighbour list among candidates, denser than the survivors
_SETTLED = 14  # among survivors
_CHANCE = 1e-5  # largest penalty that the seed draws: enough for another sample, not a worse one
_PLACES = 2.0**20  # a unit of length: finer than any sample, coarser than rounding errors
_SPREAD = 0xBF58476D1CE4E5B9  # an odd constant of splitmix64, which spreads bits well
_PINNED = -1e9  # penalty of points that must survive: no weight comes near it
_FAR = 1.4  # radii at which survivors are looked for: they push within 1.3, and move
_ERROR_ROUNDS = 8  # rounds of averaging expected errors over neighbours
_LOCAL = 2  # times that the number left of each chart is


def select(
    candidates: NDArray[np.float64],
    normals: NDArray[np.float32],
    error: NDArray[np.float32],
    owner: NDArray[np.int32],
    wanted: int,
    area: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    seed: int,
    pinned: tuple[NDArray[np.float64], NDArray[np.float32]] | None = None,
    core: NDArray[np.bool_] | None = None,
    charted: int | None = None,
    *,
    all_stay: bool = False,
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]:
    """Where the output points go: eliminate, then let the survivors settle.

    Args:
        candidates: ``(C, 3)`` float64, landed on the surface.
        normals: ``(C, 3)`` float32 unit.
        error: ``(C,)`` float32 that each expects of itself, in spacings.
        owner: ``(C,)`` int32 nearest chart of each.
        wanted: number of points of the core's charts, at most as many as their candidates.
        area: ``(M,)`` area of each chart, see :mod:`~pugeo_model.geometry.areas`.
        neighbours: ``(M, k)`` charts near each chart.
        seed: decides between candidates that are as good as each other.
        pinned: points ``(n, 3)`` and normals ``(n, 3)`` of the charts' own points, where these may
            be among the ``wanted`` and then stay where they are.
        core: ``(M,)`` charts whose points are wanted, ``None`` for all; the others are a margin
            that keeps the core's border even.
        charted: of the ``M`` so many lead that have candidates, by default all: the others are only
            there to be looked past.
        all_stay: all that are pinned are among the ``wanted``, even or not.

    Returns:
        Of the core: the charts whose own points stay, ascending; the other queries, float64; and the
        owner of each of these, int32.
    """
    core = np.ones(len(area), dtype=np.bool_) if core is None else core
    near = np.ascontiguousarray(neighbours[:, :_NEAR_CHARTS])
    there = np.arange(len(area)) < (len(area) if charted is None else charted)
    radius = packing_radius(area * (np.count_nonzero(core) / wanted))
    usual = float(
        TUNING.usual_error * (wanted / np.count_nonzero(core)) ** TUNING.usual_error_power
    )
    usual = min(max(usual, TUNING.usual_error_least), TUNING.usual_error_most)
    penalty = _error_penalty(error.astype(np.float64), owner, near, there, usual)
    penalty += _CHANCE * _draw(candidates, seed)
    held = 0
    if pinned is not None:
        held = len(pinned[0])
        owner = np.concatenate([np.arange(held, dtype=np.int32), owner])
        candidates = np.concatenate([pinned[0], candidates])
        normals = np.concatenate([pinned[1], normals])
        penalty = np.concatenate([np.full(held, _PINNED if all_stay else 0.0), penalty])

    def level(alive: NDArray[np.bool_]) -> NDArray[np.float64]:
        """What a region has kept too many of weighs more: doubt and thin walls thin some out."""
        left = np.bincount(owner[alive], minlength=len(near)).astype(np.float64)
        density = _around(left, there, neighbours, _LOCAL) / left[core].mean()
        weight: NDArray[np.float64] = np.clip(density, 0.5, 2.0)[owner] ** TUNING.levelling_power
        return weight

    kept = eliminate(
        candidates,
        chart_neighbours(
            candidates, owner, near, radius[owner], _CROWD
        ),  # not kept: they are large
        radius[owner],
        wanted,
        penalty,
        core[owner],
        level,
    )
    queries, owner = candidates[kept], owner[kept]
    first = int(np.searchsorted(kept, held))
    push = radius[owner]
    push[:first] = 0.0  # pushes, and is not pushed
    queries = _settle(queries, normals[kept], owner, near, radius, push, TUNING.repulsion_rounds)
    mine = core[owner]
    stay = owner[:first][mine[:first]]
    mine[:first] = False
    return stay, queries[mine], owner[mine]


def spread_evenly(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    area: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    core: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """One round of repulsion among points that have landed, ``(K, 3)``.

    Charts of a noisy input disagree, so that landing moves what had settled. Points next to a
    margin stay, since those beyond it are not here to push back.

    Args:
        points: ``(K, 3)`` of the core's charts.
        normals: ``(K, 3)`` unit.
        owner: ``(K,)`` nearest chart of each.
        area: ``(M,)`` area of each chart, see :mod:`~pugeo_model.geometry.areas`.
        neighbours: ``(M, k)`` charts near each chart.
        core: ``(M,)`` charts whose points these are.
    """
    near = np.ascontiguousarray(neighbours[:, :_NEAR_CHARTS])
    radius = packing_radius(area * (np.count_nonzero(core) / len(points)))
    push = np.where(core[near].all(axis=1), radius, 0.0)[owner]
    return _settle(points, normals, owner, near, radius, push, 1)


def _settle(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    owner: NDArray[np.int32],
    near: NDArray[np.int32],
    radius: NDArray[np.float64],
    push: NDArray[np.float64],
    rounds: int,
) -> NDArray[np.float64]:
    """Points ``(K, 3)`` pushed apart: ``radius`` of charts, ``push`` of points, 0 of who stays."""
    lists = chart_neighbours(points, owner, near, _FAR * radius[owner], _SETTLED)
    return repel(points, normals, lists, push, rounds)


def _draw(points: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Numbers in 0..1, ``(C,)``, that a select and the seed decide.

    And not the row: a candidate in the margins of several tiles draws the same in all of them.
    """
    drawn = np.full(len(points), seed, dtype=np.uint64)
    for column in np.rint(points.T * _PLACES).astype(np.int64).view(np.uint64):
        drawn ^= column
        drawn *= np.uint64(_SPREAD)
        drawn ^= drawn >> np.uint64(29)
    return drawn / 2.0**64


def _around(
    values: NDArray[np.float64],
    there: NDArray[np.bool_],
    neighbours: NDArray[np.int32],
    times: int,
) -> NDArray[np.float64]:
    """Means over those neighbours that are ``there``, of means, and so on; see `neighbour_mean`."""
    sums: NDArray[np.float64] = neighbour_mean(np.where(there, values, 0.0), neighbours, times)
    if not there.all():
        sums /= np.maximum(neighbour_mean(there.astype(np.float64), neighbours, times), 1e-12)
    return sums


def _error_penalty(
    error: NDArray[np.float64],
    owner: NDArray[np.int32],
    near: NDArray[np.int32],
    there: NDArray[np.bool_],
    usual: float,
) -> NDArray[np.float64]:
    """Burden of candidates that expect more than ``usual`` times the error usual around them.

    Compared with their surroundings, not with the whole cloud: where all are unsure, as along an
    edge, a penalty on all would only tear a hole. But with wide ones: at the rim of a fin all are
    unsure, and some are beyond it.
    """
    charts = len(near)
    count = np.maximum(np.bincount(owner, minlength=charts), 1)
    around = _around(np.bincount(owner, error, charts) / count, there, near, _ERROR_ROUNDS)
    excess = error / np.maximum(around[owner], 1e-12) - usual
    penalty: NDArray[np.float64] = TUNING.error_penalty * np.maximum(excess, 0.0)
    return penalty


def nearest_charts(
    queries: NDArray[np.float64],
    owner: NDArray[np.int32],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    count: int,
    charted: int | None = None,
) -> NDArray[np.int32]:
    """The ``count`` charts nearest to each spot among its owner and that one's neighbours.

    Args:
        queries: ``(K, 3)``.
        owner: ``(K,)`` chart of each.
        points: ``(M, 3)``.
        neighbours: ``(M, k)`` points near each point.
        count: how many charts. The owner stands in for those that are not there.
        charted: of the points so many lead that have charts, by default all.
    """
    found = np.empty((len(queries), count), dtype=np.int32)
    charted = len(points) if charted is None else charted
    _nearest_charts(queries, owner, points, neighbours[:, :_NEAR_CHARTS], charted, found)
    return found


@njit(cache=True, nogil=True)
def _nearest_charts(queries, owner, points, neighbours, charted, found):  # type: ignore[no-untyped-def]
    count, k = found.shape[1], neighbours.shape[1]
    best = np.empty(count)
    charts = np.empty(k + 1, dtype=np.int32)
    around = np.empty((3, k + 1))
    squared = np.empty(k + 1)
    before = -1
    for i in range(len(queries)):
        if owner[i] != before:
            # Spots mostly come chart by chart: what is around one is looked up once.
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
