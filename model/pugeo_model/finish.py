# SPDX-License-Identifier: Apache-2.0
"""The last step of a tile: signs of normals, attributes, and the cloud's own frame and units."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.attributes import transfer_attributes
from pugeo_model.cloud import Cloud
from pugeo_model.normalise import Normalisation
from pugeo_model.orient.across_tiles import TileSigns
from pugeo_model.orient.dense import orient_dense
from pugeo_model.orient.methods import orient, transfer_signs
from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.resample.elimination import packing_radius
from pugeo_model.resample.seams import BorderPoints
from pugeo_model.resample.selection import spread_evenly
from pugeo_model.tuning import TUNING

__all__ = ["Border", "UpsampledTile", "finish"]

_NO_NEIGHBOURS = np.empty((0, 0), dtype=np.int32)


@dataclass(frozen=True, eq=False)
class Border:
    """Everything that other tiles need to know of a tile: little, so that only it travels.

    Attributes:
        signs: signs of its normals up to a sign of each connected part, ``None`` where they are
            final.
        points: its points next to other tiles, ``None`` of a cloud in one piece.
    """

    signs: TileSigns | None
    points: BorderPoints | None


@dataclass(frozen=True, eq=False)
class UpsampledTile:
    """The dense points of a tile's core.

    Attributes:
        cloud: in the cloud's own frame and units.
        parts: ``(K,)`` connected part of the tile of each point; ``None`` where the signs of the
            normals are final.
        border: everything that other tiles need to know of it.
        noise: of its input, in spacings, see `noise_level`.
        normalisation: of the whole cloud.
    """

    cloud: Cloud
    parts: NDArray[np.integer[Any]] | None
    border: Border
    noise: float
    normalisation: Normalisation


def finish(prepared: PreparedTile, projected: Projected) -> UpsampledTile:
    """Orient normals, transfer colours and scalars, put offset and scale back.

    Args:
        prepared: the tile.
        projected: its dense points with normals of any sign, unit scale.
    """
    tile = prepared.tile
    if tile.keeps_input:
        # The input's points lead, in the order of the patches: put them into their own.
        own = np.argsort(prepared.order[prepared.core])
        projected = projected.take(np.append(own, np.arange(tile.core, tile.n_out)))
    elif tile.noisy is not None:
        projected = replace(projected, points=_evened(prepared, projected))
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


def _evened(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64]:
    """Charts of a noisy input disagree, so that the projection of survivors unsettles them."""
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
    """Normals ``(K, 3)``; where other tiles have a say, the tile's signs and connected parts."""
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
        # Parts are few and points many: the smallest integer type saves memory.
        return normals, tile_signs, parts.astype(np.min_scalar_type(parts.max()))
    if tile.orient == "input":
        own, _ = orient(prepared.points, axes, "input", None, prepared.cloud.normals, graph)
        return transfer_signs(projected.normals, projected.nearest, own), None, None
    normals, _ = orient(
        projected.points,
        projected.normals,
        tile.orient,
        _viewpoints(prepared, projected),
        None,
        _NO_NEIGHBOURS,
        tile.centroid,
    )
    return normals, None, None


def _viewpoints(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64] | None:
    """Sensor positions, unit scale: ``(3,)`` for all dense points, or ``(K, 3)``, one for each."""
    tile, cloud = prepared.tile, prepared.cloud
    if tile.viewpoint is not None:
        return np.asarray(tile.normalisation.unit(tile.viewpoint))
    if cloud.viewpoints is None:
        return None
    places = (cloud.viewpoints - tile.normalisation.offset) / tile.normalisation.scale
    if len(places) == 1:
        return np.asarray(places[0])
    return np.asarray(places[cloud.scalars["scan"][projected.nearest]])


def _border_points(prepared: PreparedTile, projected: Projected) -> BorderPoints:
    """Points of charts that are next to charts of other tiles."""
    tile = prepared.tile
    near_core = prepared.core[prepared.neighbours]
    surrounded = prepared.core & near_core.all(axis=1)
    rows = np.flatnonzero(~surrounded[projected.nearest])
    owner = projected.nearest[rows]
    radius = packing_radius(prepared.area * (tile.core / tile.n_out))[owner]
    if tile.keeps_input:
        radius[rows < tile.core] = 0.0
    close = near_core[:, : TUNING.orientation_neighbours].all(axis=1)
    outermost = ~(prepared.core & close)[owner]
    return BorderPoints(
        rows.astype(np.int32), projected.points[rows], projected.normals[rows], radius, outermost
    )
