# SPDX-License-Identifier: Apache-2.0
"""Signs of normals by the points of the answer.

These lie closer together than the input's, and their normals are learned: where a wall is as thin
as the input is sparse, neighbours in the input are on its other side, and neighbours in the answer
are not. The input's points, which tiles area, take their signs from them.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.orient.across_tiles import TileSigns, tile_signs
from pugeo_model.orient.mst import Edges
from pugeo_model.orient.mst_consensus import join_by_consensus
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.resample.chart_neighbours import chart_neighbours, group_by_chart
from pugeo_model.resample.elimination import packing_radius
from pugeo_model.tuning import TUNING

__all__ = ["orient_dense"]

_ALL = 5.0  # points a chart up to which all take part
_FAR = 1.35  # radii at which neighbours are looked for
_WIDTH = 12  # longest list of them
_NEAR = 6  # neighbours in the input


def orient_dense(
    rows: NDArray[np.int32],
    core: NDArray[np.bool_],
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    area: NDArray[np.float64],
    answer: tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]],
) -> tuple[TileSigns, NDArray[np.float64], NDArray[np.intp]]:
    """Let the normals of a tile's answer agree among themselves, and those of its input with them.

    Neighbours in the answer are asked first; then each point of the input agrees with the answer's
    points around it; last come neighbours in the input, which hold together what holes set apart,
    and bring in the margin, where there is no answer.

    Args:
        rows: ``(n,)`` int32 rows of the tile's input points in the whole cloud.
        core: ``(n,)`` those that are in no other tile's core.
        points: ``(n, 3)``, unit scale of the whole cloud.
        normals: ``(n, 3)`` float32 unit, of any sign.
        neighbours: ``(n, k)`` int32 rows of the tile.
        area: ``(n,)`` area that each stands for.
        answer: points ``(K, 3)``, normals ``(K, 3)`` of any sign, and the input point ``(K,)`` that
            each belongs to.

    Returns:
        The sides, and of the answer's points the signs -1 or 1 ``(K,)`` and the parts ``(K,)``.
    """
    dense, directions, owner = answer
    start, order = group_by_chart(owner, len(points))
    most = TUNING.orientation_members if len(dense) > _ALL * np.count_nonzero(core) else len(dense)
    chosen = _members(start, order, most)
    mine, some, ways = owner[chosen], dense[chosen], directions[chosen]
    held = np.maximum(np.bincount(mine, minlength=len(points)), 1)
    radius = _FAR * packing_radius(area / held)[mine]
    # The points of the answer come after those of the input.
    first = len(points)
    all_points, all_normals = np.concatenate([points, some]), np.concatenate([normals, ways])
    places = np.arange(first, first + len(mine), dtype=np.int32)
    forest = SignedUnionFind(len(all_points))
    near = Edges.among(some, ways, chart_neighbours(some, mine, neighbours, radius, _WIDTH))
    join_by_consensus(forest, near.moved(first))
    unlimited = np.zeros(len(all_points))
    join_by_consensus(forest, Edges.between(all_points, all_normals, mine, places, unlimited))
    if forest.parts > 1:
        join_by_consensus(forest, Edges.among(points, normals, neighbours[:, :_NEAR]))
    signs, parts = forest.read()
    sides = tile_signs(rows, core, points, normals, signs[:first], parts[:first], neighbours)
    agreed = ways * signs[first:, None].astype(np.float32)
    all_signs, member = np.empty(len(dense)), np.empty(len(dense), dtype=np.int32)
    _follow(dense, directions, start, order, most, some, agreed, all_signs, member)
    return sides, all_signs, parts[first:][member]


@njit(cache=True, nogil=True)
def _members(start: NDArray[Any], order: NDArray[Any], most: int) -> NDArray[np.int32]:
    """At most so many rows of each chart, chart by chart, spread over all that it has."""
    chosen = np.empty(len(order), dtype=np.int32)
    count = 0
    for chart in range(len(start) - 1):
        held = start[chart + 1] - start[chart]
        wanted = min(held, most)
        for one in range(wanted):
            chosen[count] = order[start[chart] + one * held // wanted]
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True)
def _follow(
    dense: NDArray[Any],
    directions: NDArray[Any],
    start: NDArray[Any],
    order: NDArray[Any],
    most: int,
    some: NDArray[Any],
    agreed: NDArray[Any],
    signs: NDArray[Any],
    member: NDArray[Any],
) -> None:
    """Sign of each point by the nearest of its chart's that took part, and which that is."""
    first = 0
    for chart in range(len(start) - 1):
        count = min(start[chart + 1] - start[chart], most)
        for at in range(start[chart], start[chart + 1]):
            row = order[at]
            best, least = first, np.inf
            for one in range(first, first + count):
                squared = 0.0
                for a in range(3):
                    squared += (some[one, a] - dense[row, a]) ** 2
                if squared < least:
                    best, least = one, squared
            cosine = 0.0
            for a in range(3):
                cosine += agreed[best, a] * directions[row, a]
            signs[row] = -1.0 if cosine < 0.0 else 1.0
            member[row] = best
        first += count
