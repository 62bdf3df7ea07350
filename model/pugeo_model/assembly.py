# SPDX-License-Identifier: Apache-2.0
"""From dense tiles to one dense cloud: tiles agree on signs and borders, then are joined."""

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
from pugeo_model.tiles import TileSpec

__all__ = ["Agreement", "Result", "agree", "apply_agreement", "assemble"]


@dataclass(frozen=True, eq=False)
class Agreement:
    """The decisions of all tiles together that concern one of them.

    Attributes:
        signs: of its connected parts, ``None`` where the signs of its normals are final.
        points: ``(k, 3)`` float64, places of its border points, unit scale; ``None`` where they
            stay.
    """

    signs: NDArray[np.float64] | None
    points: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Result:
    """The dense cloud and the report on its making (JSON-able)."""

    cloud: Cloud
    report: dict[str, Any]


def agree(borders: Sequence[Border]) -> list[Agreement]:
    """Orient all tiles together, and separate border points that are too close to each other.

    Args:
        borders: of all tiles, in order.
    """
    signs = [border.signs for border in borders if border.signs is not None]
    agreed = signs_across_tiles(signs) if signs else [None] * len(borders)
    # A piece of the cloud that stands apart may be a tile of its own, without border points.
    moved = iter(separate([border.points for border in borders if border.points is not None]))
    places = [None if border.points is None else next(moved) for border in borders]
    return [Agreement(*both) for both in zip(agreed, places, strict=True)]


def apply_agreement(tile: UpsampledTile, agreement: Agreement) -> Cloud:
    """The final points and normals of a tile, in the cloud's own frame and units."""
    cloud, border = tile.cloud, tile.border.points
    if border is not None and agreement.points is not None:
        moves = border.radius > 0.0
        points = cloud.points.copy()
        points[border.rows[moves]] = tile.normalisation.world(agreement.points[moves])
        cloud = replace(cloud, points=points)
    if agreement.signs is not None:
        assert cloud.normals is not None
        normals = cloud.normals * agreement.signs[tile.parts, None].astype(np.float32)
        cloud = replace(cloud, normals=normals)
    return cloud


def assemble(plan: Plan, tiles: Sequence[UpsampledTile]) -> Result:
    """Join all tiles, in order, to one cloud."""
    agreements = agree([tile.border for tile in tiles])
    clouds = [apply_agreement(*both) for both in zip(tiles, agreements, strict=True)]
    dense = clouds[0] if len(clouds) == 1 else Cloud.join(clouds)
    if not plan.tiles_in_order:
        dense = dense.take(_input_first(plan.tile_specs))
    return Result(replace(dense, notes=plan.cloud.notes), plan.final_report(tiles[0].noise))


def _input_first(specs: Sequence[TileSpec]) -> NDArray[np.int64]:
    """Rows of the joined tiles: the input's points in their order, then the new points."""
    starts = np.cumsum([0] + [spec.n_out for spec in specs])
    own, new = [], []
    for start, spec in zip(starts, specs, strict=False):
        own.append(start + np.arange(spec.core))
        new.append(start + np.arange(spec.core, spec.n_out))
    back = np.argsort(np.concatenate([spec.rows[: spec.core] for spec in specs]))
    return np.concatenate([np.concatenate(own)[back], *new])
