# SPDX-License-Identifier: Apache-2.0
"""Relative signs of normals from the output points of a tile.

Output points are denser than input points: on both sides of a wall as thin as the spacing of the
input, the nearest neighbours of an input point lie on the other side, those of an output point do
not. The input points, by which tiles are compared, get their signs from the output points.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.orient.across_tiles import TileSigns, tile_signs
from pugeo_model.orient.mst import Edges
from pugeo_model.orient.mst_consensus import join_by_consensus
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.resample.chart_neighbours import chart_neighbours, group_by_chart
from pugeo_model.resample.elimination import packing_radius
from pugeo_model.tuning import TUNING

__all__ = ["orient_dense"]


def orient_dense(
    rows: NDArray[np.int32],
    core: NDArray[np.bool_],
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    area: NDArray[np.float64],
    output: tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]],
) -> tuple[TileSigns, NDArray[np.float64], NDArray[np.intp]]:
    """Make the normals of the output and of the input of a tile consistent.

    First output points are joined with each other, then input points with their output points,
    last input points with each other, which connects parts across holes and adds the margin,
    where there are no output points.

    Args:
        rows: ``(n,)`` int32 rows of the input points in the whole cloud.
        core: ``(n,)`` bool, points of the core.
        points: ``(n, 3)`` float64, unit scale of the whole cloud.
        normals: ``(n, 3)`` float32, unit length, of any sign.
        neighbours: ``(n, k)`` int32 rows of the tile.
        area: ``(n,)`` surface area of each input point.
        output: points ``(K, 3)``, normals ``(K, 3)`` of any sign, and the nearest input point
            ``(K,)`` of each.

    Returns:
        The oriented input; signs -1 or 1 ``(K,)`` and connected parts ``(K,)`` of the output.
    """
    dense, dense_normals, owner = output
    start, order = group_by_chart(owner, len(points))
    few = len(dense) <= TUNING.orientation_complete * np.count_nonzero(core)
    most = len(dense) if few else TUNING.orientation_members
    chosen = _members(start, order, most)
    members, member_normals, member_owner = dense[chosen], dense_normals[chosen], owner[chosen]
    per_chart = np.maximum(np.bincount(member_owner, minlength=len(points)), 1)
    radius = TUNING.orientation_range * packing_radius(area / per_chart)[member_owner]
    # Nodes are the input points, then the chosen output points.
    first = len(points)
    node_points = np.concatenate([points, members])
    node_normals = np.concatenate([normals, member_normals])
    member_nodes = np.arange(first, first + len(members), dtype=np.int32)
    union_find = SignedUnionFind(len(node_points))
    near = chart_neighbours(members, member_owner, neighbours, radius, TUNING.orientation_edges)
    join_by_consensus(union_find, Edges.among(members, member_normals, near).shifted(first))
    no_limit = np.zeros(len(node_points))
    join_by_consensus(
        union_find, Edges.between(node_points, node_normals, member_owner, member_nodes, no_limit)
    )
    if union_find.parts > 1:
        near = neighbours[:, : TUNING.orientation_input_edges]
        join_by_consensus(union_find, Edges.among(points, normals, near))
    signs, parts = union_find.read()
    oriented = tile_signs(rows, core, points, normals, signs[:first], parts[:first], neighbours)
    member_normals = member_normals * signs[first:, None].astype(np.float32)
    dense_signs, nearest = np.empty(len(dense)), np.empty(len(dense), dtype=np.int32)
    _follow_members(
        dense, dense_normals, start, order, most, members, member_normals, dense_signs, nearest
    )
    return oriented, dense_signs, parts[first:][nearest]


@njit(cache=True, nogil=True)
def _members(start: NDArray[Any], order: NDArray[Any], most: int) -> NDArray[np.int32]:
    """Choose at most ``most`` rows of each chart, at regular steps; sorted by chart."""
    chosen = np.empty(len(order), dtype=np.int32)
    count = 0
    for chart in range(len(start) - 1):
        size = start[chart + 1] - start[chart]
        wanted = min(size, most)
        for step in range(wanted):
            chosen[count] = order[start[chart] + step * size // wanted]
            count += 1
    return chosen[:count]


@njit(cache=True, nogil=True)
def _follow_members(
    dense: NDArray[Any],
    dense_normals: NDArray[Any],
    start: NDArray[Any],
    order: NDArray[Any],
    most: int,
    members: NDArray[Any],
    member_normals: NDArray[Any],
    signs: NDArray[Any],
    nearest: NDArray[Any],
) -> None:
    """Give each output point the sign of the nearest member of its chart; writes the last two."""
    first = 0
    for chart in range(len(start) - 1):
        count = min(start[chart + 1] - start[chart], most)
        for at in range(start[chart], start[chart + 1]):
            row = order[at]
            best, least = first, np.inf
            for member in range(first, first + count):
                squared = 0.0
                for a in range(3):
                    squared += (members[member, a] - dense[row, a]) ** 2
                if squared < least:
                    best, least = member, squared
            cosine = 0.0
            for a in range(3):
                cosine += member_normals[best, a] * dense_normals[row, a]
            signs[row] = -1.0 if cosine < 0.0 else 1.0
            nearest[row] = best
        first += count
