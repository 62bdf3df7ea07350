# SPDX-License-Identifier: Apache-2.0
"""Assembly of dense tiles into one dense cloud, with consistent signs and without seams."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.finish import Border, UpsampledTile
from pugeo_model.orient.across_tiles import signs_across_tiles
from pugeo_model.plan import Plan
from pugeo_model.resample.seams import separate

__all__ = ["Agreement", "Result", "agree", "apply_agreement", "assemble"]


@dataclass(frozen=True, eq=False)
class Agreement:
    """Corrections of one tile that follow from all tiles together.

    Attributes:
        signs: ``(parts,)`` -1 or 1, factors of the normals of its connected parts; ``None`` if
            the signs of its normals are final.
        points: ``(k, 3)`` float64, new positions of its border points, unit scale; ``None`` if
            it has no border points.
    """

    signs: NDArray[np.float64] | None
    points: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Result:
    """Output of an upsampling run.

    Attributes:
        cloud: the dense cloud, in the input's own frame and units.
        report: counts, noise level, orientation method and notes, JSON-able.
    """

    cloud: Cloud
    report: dict[str, Any]


def agree(borders: Sequence[Border]) -> list[Agreement]:
    """Orient all tiles consistently and separate border points that are too close.

    Args:
        borders: the borders of all tiles, in order.
    """
    tile_signs = [border.signs for border in borders if border.signs is not None]
    signs = signs_across_tiles(tile_signs) if tile_signs else [None] * len(borders)
    # A tile that is far from all others has no border points.
    separated = iter(separate([border.points for border in borders if border.points is not None]))
    points = [None if border.points is None else next(separated) for border in borders]
    return [Agreement(*both) for both in zip(signs, points, strict=True)]


def apply_agreement(tile: UpsampledTile, agreement: Agreement) -> Cloud:
    """Apply the corrections of a tile; returns its cloud in the input's own frame and units."""
    cloud, border = tile.cloud, tile.border.points
    if border is not None and agreement.points is not None:
        movable = border.radius > 0.0
        points = cloud.points.copy()
        points[border.rows[movable]] = tile.normalisation.world(agreement.points[movable])
        cloud = replace(cloud, points=points)
    if agreement.signs is not None:
        assert cloud.normals is not None
        normals = cloud.normals * agreement.signs[tile.parts, None].astype(np.float32)
        cloud = replace(cloud, normals=normals)
    return cloud


def assemble(plan: Plan, tiles: Sequence[UpsampledTile]) -> Result:
    """Join all tiles, in order, into one cloud."""
    agreements = agree([tile.border for tile in tiles])
    clouds = [apply_agreement(*both) for both in zip(tiles, agreements, strict=True)]
    dense = clouds[0] if len(clouds) == 1 else Cloud.join(clouds)
    if not plan.tiles_in_order:
        dense = dense.take(_input_first(plan))
    return Result(replace(dense, notes=plan.cloud.notes), plan.final_report(tiles[0].noise))


def _input_first(plan: Plan) -> NDArray[np.int64]:
    """Rows of the joined tiles: the input points in the input's order, then the new points."""
    starts = np.cumsum([0] + [spec.n_out for spec in plan.tile_specs])
    inputs, new, rows = [], [], []
    for start, spec in zip(starts, plan.tile_specs, strict=False):
        rows.append(plan.input_rows(spec))
        inputs.append(start + np.arange(len(rows[-1])))
        new.append(start + np.arange(len(rows[-1]), spec.n_out))
    input_order = np.argsort(np.concatenate(rows))
    return np.concatenate([np.concatenate(inputs)[input_order], *new])
