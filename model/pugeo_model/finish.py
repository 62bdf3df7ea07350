# SPDX-License-Identifier: Apache-2.0
"""Last stage of a tile: signs of normals, attributes, and the cloud's own frame and units."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.attributes import transfer_attributes
from pugeo_model.cloud import Cloud
from pugeo_model.expected_error import EXPECTED_ERROR, expected_errors
from pugeo_model.geometry.neighbours import knn
from pugeo_model.normalise import Normalisation
from pugeo_model.orient.across_tiles import TileSigns
from pugeo_model.orient.dense import orient_dense
from pugeo_model.orient.signs import orient_along, orient_by_input, transfer_signs
from pugeo_model.orient.stations import orient_by_stations
from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.resample.bounds import bounded_spacing, distance_bounds
from pugeo_model.resample.seams import BorderPoints
from pugeo_model.resample.selection import spread_evenly
from pugeo_model.tiles import Tile
from pugeo_model.tuning import TUNING

__all__ = ["Border", "UpsampledTile", "finish"]

# Scales of clouds whose lengths are float32 numbers.
_SMALLEST_FLOAT32, _LARGEST_FLOAT32 = 1e-25, 1e35


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
    if tile.keeps_input and tile.input is None:
        # The input points lead, in the order of the patches; restore the order of the tile.
        tile_order = np.argsort(prepared.order[prepared.core])
        projected = projected.take(np.append(tile_order, np.arange(tile.core, tile.n_out)))
    elif not tile.keeps_input and (tile.noisy is not None or tile.input is not None):
        projected = replace(projected, points=_spread_evenly(prepared, projected))
    projected = replace(projected, points=_along_curves(prepared, projected))
    projected, room = _within_bounds(prepared, projected)
    normals, signs, parts = _oriented(prepared, projected)
    places = prepared.points if tile.input is None else tile.input.points
    source = replace(prepared.cloud, points=places)
    colors, scalars = transfer_attributes(source, projected.points)
    if tile.keeps_input:
        _keep_attributes(tile, colors, scalars)
    if tile.confidence:
        scalars[EXPECTED_ERROR] = _in_units(
            expected_errors(prepared, projected), tile.normalisation.scale
        )
    dense = replace(
        prepared.cloud,
        points=tile.normalisation.world(projected.points),
        normals=normals,
        colors=colors,
        scalars=scalars,
    )
    dense.points[: tile.unmoved] = tile.cloud.points[: tile.unmoved]
    border = Border(
        signs, None if prepared.core.all() else _border_points(prepared, projected, room)
    )
    return UpsampledTile(dense, parts, border, prepared.noise, tile.normalisation)


def _in_units(lengths: NDArray[np.float32], scale: float) -> NDArray[np.floating[Any]]:
    """Lengths of the unit frame in the units of the cloud; float64 where float32 ends."""
    if _SMALLEST_FLOAT32 < scale < _LARGEST_FLOAT32:
        return lengths * np.float32(scale)
    return lengths.astype(np.float64) * scale


def _keep_attributes(
    tile: Tile, colors: NDArray[Any] | None, scalars: dict[str, NDArray[Any]]
) -> None:
    """Give the leading input points their own colours and scalars, also if they were moved."""
    if colors is not None and tile.cloud.colors is not None:
        colors[: tile.kept] = tile.cloud.colors[: tile.kept]
    for name, values in scalars.items():
        values[: tile.kept] = tile.cloud.scalars[name][: tile.kept]


def _spread_evenly(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64]:
    """Restore the even spacing: projection onto charts of a noisy input disturbs it."""
    return spread_evenly(
        projected.points,
        projected.normals,
        projected.nearest,
        prepared.radii,
        prepared.neighbours,
        prepared.core,
    )


def _along_curves(prepared: PreparedTile, projected: Projected) -> NDArray[np.float64]:
    """Move points beside wires and single scan lines onto these; kept ones stay."""
    points = prepared.along_curves(projected.points, projected.nearest)
    kept = prepared.tile.unmoved
    return points if not kept else np.concatenate([projected.points[:kept], points[kept:]])


def _within_bounds(
    prepared: PreparedTile, projected: Projected
) -> tuple[Projected, NDArray[np.float64]]:
    """Move points that are too far from the input to the largest distance; kept ones stay.

    Returns:
        The points, and by how much each may move before it is too far, ``(K,)``.
    """
    tile = prepared.tile
    limit, nearest = distance_bounds(
        projected.points,
        projected.normals,
        projected.nearest,
        prepared.points,
        prepared.neighbours,
        bounded_spacing(prepared.frames.spacing, prepared.neighbours),
        tile.max_gap,
        shadows=False,
    )
    points, room = _moved_within(projected.points, prepared.points[nearest], limit, tile.unmoved)
    if tile.max_gap is not None and (
        tile.moves_input or tile.input is not None or tile.noisy is not None
    ):
        # Charts of a noisy scan lie between its points: the gap is to the points themselves.
        places = tile.normalisation.unit(tile.cloud.points)
        # A denoised point is one of the input, so the gap is to its own place.
        own = tile.moves_input
        places = places[: tile.kept] if own else places[knn(cKDTree(places), points, 1)[1][:, 0]]
        gap = np.full(len(points), tile.max_gap)
        points, less = _moved_within(points, places, gap, tile.unmoved)
        room = np.minimum(room, less)
    return replace(projected, points=points), room


def _moved_within(
    points: NDArray[np.float64],
    places: NDArray[np.float64],
    limit: NDArray[np.float64],
    unmoved: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Move points ``(K, 3)`` towards ``places`` where they are further away than ``limit``.

    Returns:
        The points, of which the ``unmoved`` leading ones stay, and the distance that each is
        below its limit, >= 0.
    """
    offset = points - places
    distance = np.linalg.norm(offset, axis=1)
    far = distance > limit
    far[:unmoved] = False
    if far.any():
        points = points.copy()
        points[far] = places[far] + offset[far] * (limit[far] / distance[far])[:, None]
    return points, np.maximum(limit - distance, 0.0)


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
        oriented = orient_by_input(axes, _given_normals(prepared), graph)
        return transfer_signs(projected.normals, projected.nearest, oriented), None, None
    if tile.orient == "viewpoint" and tile.sights is not None:
        oriented = orient_by_stations(axes, tile.sights[prepared.order], graph)
        return transfer_signs(projected.normals, projected.nearest, oriented), None, None
    if tile.orient == "viewpoint":
        assert tile.viewpoint is not None
        place = tile.normalisation.unit(tile.viewpoint)
        normals = orient_along(projected.normals, place - projected.points)
    elif tile.orient == "outward":
        normals = orient_along(projected.normals, projected.points - tile.centroid)
    else:
        normals = projected.normals
    return normals, None, None


def _given_normals(prepared: PreparedTile) -> NDArray[np.float32]:
    """Normals of the input at the charts ``(M, 3)``, summed over the points of a chart."""
    given, source = prepared.cloud.normals, prepared.tile.input
    assert given is not None
    if source is None:
        return given
    chart = np.argsort(prepared.order)[source.chart]
    count = len(prepared.points)
    sums = [np.bincount(chart, column, count) for column in np.nan_to_num(given).T]
    return np.stack(sums, axis=1).astype(np.float32)


def _border_points(
    prepared: PreparedTile, projected: Projected, room: NDArray[np.float64]
) -> BorderPoints:
    """Output points whose nearest input point has a neighbour in another tile."""
    tile = prepared.tile
    near_core = prepared.core[prepared.neighbours]
    interior = prepared.core & near_core.all(axis=1)
    rows = np.flatnonzero(~interior[projected.nearest])
    owner = projected.nearest[rows]
    radius = prepared.radii[owner]
    if tile.keeps_input:
        radius[rows < tile.kept] = 0.0
    close = near_core[:, : TUNING.orientation_neighbours].all(axis=1)
    outermost = ~(prepared.core & close)[owner]
    return BorderPoints(
        rows.astype(np.int32),
        projected.points[rows],
        projected.normals[rows],
        radius,
        outermost,
        room[rows],
    )
