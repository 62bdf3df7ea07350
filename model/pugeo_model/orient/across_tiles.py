# SPDX-License-Identifier: Apache-2.0
"""Consistent signs of normals across tiles.

Within each connected part of a tile the normals are consistent already. The points in the margin
of a tile are in the core of another one, so that both tiles have normals there; their agreement
gives the relative signs of the parts, along a minimum spanning tree of the parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.orient.mst import spanning_tree_signs
from pugeo_model.orient.outward import OutwardEvidence, collect_evidence, outward_signs
from pugeo_model.orient.signs import row_dots

__all__ = ["TileSigns", "signs_across_tiles", "tile_signs"]


@dataclass(frozen=True, eq=False)
class TileSigns:
    """Consistently oriented normals of the ``n`` input points of a tile.

    Attributes:
        rows: ``(n,)`` int32 rows in the whole cloud.
        core: ``(n,)`` bool, points of the core.
        normals: ``(n, 3)`` float32, consistent within each part.
        parts: ``(n,)`` connected part of each point, numbered from 0.
        evidence: for the outer side of each part, from the points of the core.
    """

    rows: NDArray[np.int32]
    core: NDArray[np.bool_]
    normals: NDArray[np.float32]
    parts: NDArray[np.intp]
    evidence: OutwardEvidence


def tile_signs(
    rows: NDArray[np.int32],
    core: NDArray[np.bool_],
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    signs: NDArray[np.float64],
    parts: NDArray[np.intp],
    neighbours: NDArray[np.integer[Any]],
) -> TileSigns:
    """Apply relative signs to the normals of a tile and collect evidence for the outer side.

    Args:
        rows: ``(n,)`` int32 rows in the whole cloud.
        core: ``(n,)`` bool, points of the core.
        points: ``(n, 3)`` float64, unit scale of the whole cloud.
        normals: ``(n, 3)`` float32, unit length, of any sign.
        signs: ``(n,)`` -1 or 1, which make the normals of each part consistent.
        parts: ``(n,)`` connected part of each point, numbered from 0.
        neighbours: ``(n, k)`` rows of the tile.
    """
    oriented = normals * signs[:, None].astype(np.float32)
    evidence = collect_evidence(points, oriented, parts, int(parts.max()) + 1, neighbours, core)
    return TileSigns(rows, core, oriented, parts, evidence)


def signs_across_tiles(tiles: Sequence[TileSigns]) -> list[NDArray[np.float64]]:
    """Determine a sign for each part of each tile, so that all normals point outward.

    Args:
        tiles: all tiles.

    Returns:
        For each tile -1 or 1 ``(parts,)`` float64.
    """
    first = np.cumsum([0, *(len(tile.evidence.count) for tile in tiles)])
    left, right, votes = _votes(tiles, first)
    # The more points agree (or disagree), the lighter the edge.
    weights = (1.0 / (1e-3 + np.abs(votes))).astype(np.float32)
    signs, groups = spanning_tree_signs(int(first[-1]), left, right, weights, votes < 0)
    evidence = OutwardEvidence.join([tile.evidence for tile in tiles])
    signs = signs * outward_signs(evidence, groups, signs)[groups]
    return np.split(signs, first[1:-1])


def _votes(
    tiles: Sequence[TileSigns], first: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Pairs of parts that share points, with the sum of cosines between their normals there.

    Returns:
        Both parts, numbered across tiles, the lower first, and the sum of each pair.
    """
    count = max(int(tile.rows.max()) for tile in tiles) + 1
    owner = np.zeros(count, dtype=np.intp)
    normals = np.zeros((count, 3), dtype=np.float32)
    for tile, start in zip(tiles, first, strict=False):
        core_rows = tile.rows[tile.core]
        owner[core_rows] = start + tile.parts[tile.core]
        normals[core_rows] = tile.normals[tile.core]
    pairs, cosines = [], []
    for tile, start in zip(tiles, first, strict=False):
        shared = tile.rows[~tile.core]
        margin_parts = start + tile.parts[~tile.core]
        core_parts = owner[shared]
        low, high = np.minimum(margin_parts, core_parts), np.maximum(margin_parts, core_parts)
        pairs.append(low * first[-1] + high)
        cosines.append(row_dots(tile.normals[~tile.core], normals[shared]).astype(np.float64))
    found, which = np.unique(np.concatenate(pairs), return_inverse=True)
    votes = np.zeros(len(found))
    np.add.at(votes, which, np.concatenate(cosines))
    return found // first[-1], found % first[-1], votes
