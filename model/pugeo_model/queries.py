# SPDX-License-Identifier: Apache-2.0
"""The points of a tile that are projected onto its charts: input points, candidates, survivors."""

from dataclasses import replace

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
from pugeo_model.resample.bounds import are_beyond, bounded_spacing
from pugeo_model.resample.nearest_charts import nearest_charts
from pugeo_model.resample.quotas import chosen_candidates
from pugeo_model.resample.selection import select
from pugeo_model.tuning import TUNING

__all__ = ["input_queries", "propose", "select_survivors"]


def input_queries(prepared: PreparedTile, atlas: Atlas) -> ProjectionQuery:
    """Return the charted points, each with the charts nearest to it."""
    rows = np.arange(prepared.tile.charted, dtype=np.int32)
    return _query(prepared, atlas, prepared.charted_points, rows)


def propose(prepared: PreparedTile, atlas: Atlas) -> ProjectionQuery:
    """Return the candidates of all charts on their tangent planes: ``x + T (u, v, 0)`` (eq. 4).

    The input points lead: their move under projection shows whether they are exact.
    """
    inputs, owner = prepared.input_points
    if prepared.adds_nothing:
        return _query(prepared, atlas, inputs[:0], owner[:0])
    points, count = prepared.charted_points, prepared.candidates
    candidates = (points[:, None] + atlas.candidates).reshape(-1, 3)
    proposer = np.repeat(np.arange(prepared.tile.charted, dtype=np.int32), count)
    if prepared.quotas is not None:
        quotas, total = prepared.quotas, float(prepared.quotas[prepared.core].sum())
        chosen = chosen_candidates(quotas[: len(points)], total, prepared.tile.n_out, count)
        candidates, proposer = candidates[chosen], proposer[chosen]
    return _query(
        prepared,
        atlas,
        np.concatenate([inputs, candidates]),
        np.concatenate([owner, proposer]),
        charts=charts_per_candidate(count),
    )


def select_survivors(prepared: PreparedTile, atlas: Atlas, projected: Projected) -> ProjectionQuery:
    """Select exactly ``n_out`` evenly distributed points; kept input points lead.

    Args:
        prepared: the tile.
        atlas: its charts.
        projected: the points of `propose`, projected.
    """
    inputs, input_owner = prepared.input_points
    if prepared.adds_nothing:
        in_core = prepared.core[input_owner]
        fixed = prepared.tile.unmoved
        return _query(prepared, atlas, inputs[in_core], input_owner[in_core], fixed=fixed)
    tile = prepared.tile
    projected_inputs = projected.take(slice(0, len(inputs)))
    candidates = projected.take(slice(len(inputs), None))
    candidates = replace(
        candidates, points=prepared.along_curves(candidates.points, candidates.nearest)
    )
    exact = _is_exact(prepared, projected_inputs)
    pinned = None
    if tile.keeps_input or exact:
        pinned = inputs, projected_inputs.normals, input_owner
    has_errors = not (exact or tile.keeps_input or _is_averaged(prepared))
    # Some of a scan's points have no chart of their own: the scanner chose where they lie.
    is_scan = has_errors and tile.input is not None
    beyond = are_beyond(
        candidates.points,
        candidates.normals,
        candidates.nearest,
        prepared.points,
        prepared.neighbours,
        bounded_spacing(prepared.frames.spacing, prepared.neighbours),
        tile.max_gap,
        shadows=has_errors,
        error=candidates.error if is_scan else None,
    )
    kept, points, owner = select(
        candidates.points,
        candidates.normals,
        candidates.error,
        candidates.nearest,
        tile.n_out,
        prepared.radii,
        prepared.neighbours,
        tile.seed,
        pinned,
        prepared.core,
        tile.charted,
        prepared.quotas,
        beyond,
        keep_all=tile.keeps_input,
        most_error=TUNING.usual_error_scan if is_scan else TUNING.usual_error_most,
    )
    points = np.concatenate([inputs[kept], points])
    owner = np.concatenate([input_owner[kept], owner])
    return _query(prepared, atlas, points, owner, fixed=len(kept))


def _is_exact(prepared: PreparedTile, projected_inputs: Projected) -> bool:
    """Return whether the input points lie on the surface, so that they may be output points."""
    tile = prepared.tile
    if tile.noisy is not None or tile.input is not None or tile.keeps_input:
        return False
    return input_is_exact(prepared, projected_inputs.points)


def _is_averaged(prepared: PreparedTile) -> bool:
    """Return whether most charts represent several points: their noise is then averaged."""
    source = prepared.tile.input
    return source is not None and len(prepared.points) < TUNING.averaged_share * len(source.points)


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
