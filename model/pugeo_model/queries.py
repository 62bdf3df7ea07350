# SPDX-License-Identifier: Apache-2.0
"""The points of a tile that are projected onto its charts: input points, candidates, survivors."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.denoise import input_is_exact
from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import (
    BLENDED_CHARTS,
    Atlas,
    Projected,
    ProjectionQuery,
    charts_per_candidate,
)
from pugeo_model.resample.nearest_charts import nearest_charts
from pugeo_model.resample.selection import select

__all__ = ["input_queries", "propose", "select_survivors"]


def input_queries(prepared: PreparedTile, atlas: Atlas) -> ProjectionQuery:
    """Return the charted input points, each with the charts nearest to it."""
    return _query(prepared, atlas, prepared.charted_points, _charted_rows(prepared))


def propose(prepared: PreparedTile, atlas: Atlas) -> ProjectionQuery:
    """Return the candidates of all charts on their tangent planes: ``x + T (u, v, 0)`` (eq. 4).

    The charted input points lead: their move under projection shows whether they are exact.
    """
    rows = _charted_rows(prepared)
    if prepared.adds_nothing:
        return _query(prepared, atlas, prepared.points[:0], rows[:0])
    points = prepared.charted_points
    candidates = (points[:, None] + atlas.candidates).reshape(-1, 3)
    count = prepared.tile.candidates
    return _query(
        prepared,
        atlas,
        np.concatenate([points, candidates]),
        np.concatenate([rows, np.repeat(rows, count)]),
        charts=charts_per_candidate(count),
    )


def select_survivors(prepared: PreparedTile, atlas: Atlas, projected: Projected) -> ProjectionQuery:
    """Select exactly ``n_out`` evenly distributed points; kept input points lead.

    Args:
        prepared: the tile.
        atlas: its charts.
        projected: the points of `propose`, projected.
    """
    if prepared.adds_nothing:
        rows = np.flatnonzero(prepared.core).astype(np.int32)
        return _query(prepared, atlas, prepared.points[rows], rows, fixed=len(rows))
    tile = prepared.tile
    inputs = projected.take(slice(0, tile.charted))
    candidates = projected.take(slice(tile.charted, None))
    exact = tile.noisy is None and input_is_exact(prepared, inputs.points)
    pinned = None
    if tile.keeps_input or exact:
        pinned = prepared.charted_points, inputs.normals
    kept, points, owner = select(
        candidates.points,
        candidates.normals,
        candidates.error,
        candidates.nearest,
        tile.n_out,
        prepared.area,
        prepared.neighbours,
        tile.seed,
        pinned,
        prepared.core,
        tile.charted,
        keep_all=tile.keeps_input,
    )
    points = np.concatenate([prepared.points[kept], points])
    return _query(prepared, atlas, points, np.concatenate([kept, owner]), fixed=len(kept))


def _charted_rows(prepared: PreparedTile) -> NDArray[np.int32]:
    return np.arange(prepared.tile.charted, dtype=np.int32)


def _query(
    prepared: PreparedTile,
    atlas: Atlas,
    points: NDArray[np.float64],
    owner: NDArray[np.int32],
    *,
    charts: int = BLENDED_CHARTS,
    fixed: int = 0,
) -> ProjectionQuery:
    near = nearest_charts(
        points, owner, prepared.points, prepared.neighbours, charts, prepared.tile.charted
    )
    return ProjectionQuery(atlas, points, near, fixed)
