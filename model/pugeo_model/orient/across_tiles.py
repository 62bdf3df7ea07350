# SPDX-License-Identifier: Apache-2.0
"""Signs of normals across the borders of tiles.

Within a tile neighbours agree already. Points in the margin of one tile are in the core of
another, so both say which way their normals point: where they contradict each other, one of the
two is turned over, along a spanning tree that trusts most whom most points vouch for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.orient.mst import row_dots, spanning_tree_signs
from pugeo_model.orient.outward import OutwardEvidence, collect_evidence, outward_signs

__all__ = ["TileSigns", "signs_across_tiles", "tile_signs"]


@dataclass(frozen=True, eq=False)
class TileSigns:
    """What a tile knows of the sides of its ``n`` sparse points.

    Attributes:
        rows: ``(n,)`` int32 rows in the whole cloud.
        core: ``(n,)`` which points are in no other tile's core.
        normals: ``(n, 3)``, consistent within each part.
        parts: ``(n,)`` connected part of each, numbered from 0.
        evidence: of the parts, by the points of the core.
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
    """The sides of a tile whose normals agree among themselves.

    Args:
        rows: ``(n,)`` int32 rows in the whole cloud.
        core: ``(n,)``.
        points: ``(n, 3)``, unit scale of the whole cloud.
        normals: ``(n, 3)`` float32 unit, of any sign.
        signs: ``(n,)`` -1 or 1, by which those of each part agree.
        parts: ``(n,)`` connected part of each, numbered from 0.
        neighbours: ``(n, k)`` rows of the tile.
    """
    agreed = normals * signs[:, None].astype(np.float32)
    evidence = collect_evidence(points, agreed, parts, int(parts.max()) + 1, neighbours, core)
    return TileSigns(rows, core, agreed, parts, evidence)


def signs_across_tiles(tiles: Sequence[TileSigns]) -> list[NDArray[np.float64]]:
    """Signs, for each tile those of its parts, by which all normals point outward together."""
    first = np.cumsum([0, *(len(tile.evidence.count) for tile in tiles)])
    left, right, votes = _votes(tiles, first)
    # Many points that agree (or disagree) well make a light edge.
    weights = (1.0 / (1e-3 + np.abs(votes))).astype(np.float32)
    signs, groups = spanning_tree_signs(int(first[-1]), left, right, weights, votes < 0)
    evidence = OutwardEvidence.join([tile.evidence for tile in tiles])
    signs = signs * outward_signs(evidence, groups, signs)[groups]
    return np.split(signs, first[1:-1])


def _votes(
    tiles: Sequence[TileSigns], first: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Pairs of parts (the lower first) that share points, and how far these agree: cosines, summed.

    Returns:
        Both parts, numbered across tiles, and the sum of each pair.
    """
    count = max(int(tile.rows.max()) for tile in tiles) + 1
    owner = np.zeros(count, dtype=np.intp)
    normals = np.zeros((count, 3), dtype=np.float32)
    for tile, start in zip(tiles, first, strict=False):
        mine = tile.rows[tile.core]
        owner[mine] = start + tile.parts[tile.core]
        normals[mine] = tile.normals[tile.core]
    pairs, cosines = [], []
    for tile, start in zip(tiles, first, strict=False):
        shared = tile.rows[~tile.core]
        here = start + tile.parts[~tile.core]
        there = owner[shared]
        pairs.append(np.minimum(here, there) * first[-1] + np.maximum(here, there))
        cosines.append(row_dots(tile.normals[~tile.core], normals[shared]).astype(np.float64))
    found, which = np.unique(np.concatenate(pairs), return_inverse=True)
    votes = np.zeros(len(found))
    np.add.at(votes, which, np.concatenate(cosines))
    return found // first[-1], found % first[-1], votes
