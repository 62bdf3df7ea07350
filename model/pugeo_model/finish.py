# SPDX-License-Identifier: Apache-2.0
"""Last stage of a tile: signs of normals, attributes, and the cloud's own frame and units."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.attributes import transfer_attributes
from pugeo_model.cloud import Cloud
from pugeo_model.normalise import Normalisation
from pugeo_model.orient.across_tiles import TileSigns
from pugeo_model.orient.dense import orient_dense
from pugeo_model.orient.signs import orient_along, orient_by_input, transfer_signs
from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.resample.elimination import packing_radius
from pugeo_model.resample.seams import BorderPoints
from pugeo_model.resample.selection import spread_evenly
from pugeo_model.tuning import TUNING

__all__ = ["Border", "UpsampledTile", "finish"]


@dataclass(frozen=True, eq=False)
class Border:
    """Data of a tile that `agree` needs; small, since it is sent between processes.

    Attributes:
        signs: normals of the tile, consistent within each connected part; ``None`` if their
            signs are final.
        points: its points next to other tiles; ``None`` if the tile has no margin.
    """

    signs: TileSigns | None
    points: BorderPoints | None


@dataclass(frozen=True, eq=False)
class UpsampledTile:
    """The dense points of a tile's core.

    Attributes:
        cloud: the points, in the input's own frame and units.
        parts: ``(K,)`` connected part of each point; ``None`` if the signs of the normals are
            final.
        border: data for `agree`.
        noise: of its input, in spacings, see `noise_level`.
        normalisation: map between the cloud's own frame and the unit frame.
    """

    cloud: Cloud
    parts: NDArray[np.integer[Any]] | None
    border: Border
    noise: float
    normalisation: Normalisation


def finish(prepared: PreparedTile, projected: Projected) -> UpsampledTile:
    """Orient normals, interpolate colours and scalars, restore offset and scale.

    Args:
        prepared: the tile.
        projected: its dense points with normals of any sign, unit scale.
    """
    tile = prepared.tile
    if tile.keeps_input:
        # The input points lead, in the order of the patches; restore the order of the tile.
        tile_order = np.argsort(prepared.order[prepared.core])
        projected = projected.take(np.append(tile_order, np.arange(tile.core, tile.n_out)))
    elif tile.noisy is not None:
        projected = replace(projected, points=_spread_evenly(prepared, projected))
    normals, signs, parts = _oriented(prepared, projected)
    source = replace(prepared.cloud, points=prepared.points)
    colors, scalars = transfer_attributes(source, projected.points)
    dense = replace(
        prepared.cloud,
        points=tile.normalisation.world(projected.points),
        normals=normals,
        colors=colors,
        scalars=scalars,
    )
    if tile.keeps_input:
        dense.points[: tile.core] = tile.cloud.points[: tile.core]
    border = Border(signs, None if prepared.core.all() else _border_points(prepared, projected))
    return UpsampledTile(dense, parts, border, prepared.noise, tile.normalisation)


def _spread_evenly(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64]:
    """Restore the even spacing: projection onto charts of a noisy input disturbs it."""
    return spread_evenly(
        projected.points,
        projected.normals,
        projected.nearest,
        prepared.area,
        prepared.neighbours,
        prepared.core,
    )


def _oriented(
    prepared: PreparedTile, projected: Projected
) -> tuple[NDArray[np.float32], TileSigns | None, NDArray[np.integer[Any]] | None]:
    """Normals ``(K, 3)``; for ``mst`` also the signs and the connected parts ``(K,)``."""
    tile, axes = prepared.tile, prepared.frames.axes[:, 2]
    graph = prepared.neighbours[:, : TUNING.orientation_neighbours]
    if tile.orient == "mst":
        tile_signs, signs, parts = orient_dense(
            tile.rows[prepared.order],
            prepared.core,
            prepared.points,
            axes,
            graph,
            prepared.area,
            (projected.points, projected.normals, projected.nearest),
        )
        normals = projected.normals * signs[:, None].astype(np.float32)
        # The smallest integer dtype saves memory: parts are few, points are many.
        return normals, tile_signs, parts.astype(np.min_scalar_type(parts.max()))
    if tile.orient == "input":
        assert prepared.cloud.normals is not None
        oriented = orient_by_input(axes, prepared.cloud.normals, graph)
        return transfer_signs(projected.normals, projected.nearest, oriented), None, None
    if tile.orient == "viewpoint":
        viewpoints = _viewpoints(prepared, projected)
        normals = orient_along(projected.normals, viewpoints - projected.points)
    elif tile.orient == "outward":
        normals = orient_along(projected.normals, projected.points - tile.centroid)
    else:
        normals = projected.normals
    return normals, None, None


def _viewpoints(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64]:
    """Sensor positions, unit scale: ``(3,)`` for all dense points, or ``(K, 3)``, one for each."""
    tile, cloud = prepared.tile, prepared.cloud
    if tile.viewpoint is not None:
        return np.asarray(tile.normalisation.unit(tile.viewpoint))
    assert cloud.viewpoints is not None
    places = (cloud.viewpoints - tile.normalisation.offset) / tile.normalisation.scale
    if len(places) == 1:
        return np.asarray(places[0])
    return np.asarray(places[cloud.scalars["scan"][projected.nearest]])


def _border_points(prepared: PreparedTile, projected: Projected) -> BorderPoints:
    """Output points whose nearest input point has a neighbour in another tile."""
    tile = prepared.tile
    near_core = prepared.core[prepared.neighbours]
    interior = prepared.core & near_core.all(axis=1)
    rows = np.flatnonzero(~interior[projected.nearest])
    owner = projected.nearest[rows]
    radius = packing_radius(prepared.area * (tile.core / tile.n_out))[owner]
    if tile.keeps_input:
        radius[rows < tile.core] = 0.0
    close = near_core[:, : TUNING.orientation_neighbours].all(axis=1)
    outermost = ~(prepared.core & close)[owner]
    return BorderPoints(
        rows.astype(np.int32), projected.points[rows], projected.normals[rows], radius, outermost
    )
