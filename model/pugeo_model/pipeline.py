# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud: clean, normalise, patches, network, merge, finish.

    plan       = survey(cloud, options)
    for tile in plan.tiles:                       # one, unless the cloud is large
        job        = prepare(tile)
        charts     = [predict(model, patch, job.candidates) for patch in job.patches]
        candidates = [land(model, parcel) for parcel in propose(job, charts)]
        points     = [land(model, parcel) for parcel in merge(job, charts, candidates)]
        piece      = finish(job, points)
    result     = assemble(plan, pieces)

The stages are plain functions of plain data, so that the command line runs them in a row and the
service spreads tiles, ``predict`` and ``land`` over its workers; nothing else differs between the
two. Candidates land before the merge too: charts of their neighbours pull outliers in, and the
merge then spreads points that are where they seem to be.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pugeo_model.clean import clean
from pugeo_model.cloud import Cloud
from pugeo_model.finish.attributes import carry
from pugeo_model.finish.joining import Sides, signs_of_parts, take_sides
from pugeo_model.finish.orientation import method_of, orient, propagate
from pugeo_model.geometry.chunks import PATCH_SIZE, chunks
from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import Patch, cut
from pugeo_model.merge.atlas import (
    BLENDED,
    Atlas,
    Landed,
    Landing,
    PatchCharts,
    bind,
    parcels,
    screened,
)
from pugeo_model.merge.placement import even_out, place, shares
from pugeo_model.normalise import normalise
from pugeo_model.options import MOST, Options, refuse
from pugeo_model.plan import Job, Piece, Plan, Result
from pugeo_model.tiles import Cut, Tile, cut_tiles

if TYPE_CHECKING:
    from pugeo_model.network.model import Model

__all__ = [
    "Job",
    "Piece",
    "Plan",
    "Result",
    "agree",
    "assemble",
    "finish",
    "land",
    "merge",
    "predict",
    "prepare",
    "propose",
    "survey",
    "turn",
]

Signs = NDArray[np.float64] | None
"""Of the parts of a tile, ``None`` where its normals are final."""

# Spacings that half of the input's points move at most, when they land, of an input without noise:
# 0.002 to 0.007 on clean and even validation inputs, to 0.03 on random ones, 0.02 to 0.18 with 1 %.
_EXACT = 0.02
_NOISY = 0.1  # spacings: 0.03 and 0.07 on clean and even ones, 0.17 with 1 %, 0.27 with 2 %
_TREE = 12  # neighbours in the graph that hands signs of normals on: more cost time, mend little
_NONE = np.empty((0, 0), dtype=np.int32)


def survey(cloud: Cloud, options: Options, tile_size: int | None = None) -> Plan:
    """Clean, normalise, cut into tiles.

    Args:
        cloud: the input.
        options: what is asked for.
        tile_size: input points of a tile at most; chosen by the size of its answer if ``None``.

    Raises:
        UntreatableCloud: the points left after cleaning span no surface.
        BadOption: ``n_points`` is not 1 to 32 times the points left, or ``orient`` asks for what
            the cloud does not have.
    """
    cleaned, dropped = clean(cloud)
    points, placement = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    if not count <= n_out <= MOST * count:
        refuse(
            "n_points",
            n_out,
            f"from {count} to {int(MOST) * count} (1 to 32 times the points left after cleaning)",
            limit=[count, int(MOST) * count],
        )
    cuts, noise = cut_tiles(points, n_out, tile_size)
    given = cleaned.normals is not None
    method = method_of(options.orient, options.viewpoint, has_normals=given)
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "dropped": {"non_finite": dropped.non_finite, "duplicate": dropped.duplicate},
        "patches": sum(cut.patches for cut in cuts),
        "tiles": len(cuts),
        "ratio": n_out / count,
        "orient": method,
        "notes": list(cleaned.notes),
    }
    return Plan(
        cloud=cleaned,
        points=points,
        placement=placement,
        centroid=points.mean(axis=0),
        cuts=cuts,
        noise=noise,
        options=options,
        orient=method,
        n_out=n_out,
        report=report,
    )


def prepare(tile: Tile) -> Job:
    """Find neighbours and frames, cut patches."""
    # Rows in the order of the chunks: a patch's core is then a slice of every array to come.
    parts = chunks(tile.points, PATCH_SIZE)
    order = np.concatenate(parts)
    points = tile.points[order]
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances), tile.noise)
    ends = np.cumsum([0] + [len(part) for part in parts])
    patches = [
        cut(np.arange(start, stop, dtype=np.int32), points, neighbours, frames)
        for start, stop in itertools.pairwise(ends)
    ]
    return Job(
        tile, tile.cloud.take(order), order, order < tile.core, points, neighbours, frames, patches
    )


def predict(model: "Model", patch: Patch, candidates: int) -> PatchCharts:
    """The network: charts of a patch and what they propose. Runs on workers."""
    return model.charts(patch, candidates)


def propose(job: Job, charts: Sequence[PatchCharts]) -> list[Landing]:
    """The candidates of all charts, in parcels with the charts they land on.

    A parcel is led by the input points of its patch: where they land tells what they are worth.
    """
    if job.nothing_new:
        return []
    atlas = bind(charts)
    rows = np.arange(len(job.points), dtype=np.int32)
    spots = (job.points[:, None] + atlas.candidates).reshape(-1, 3)
    return _parcels(
        job,
        atlas,
        np.concatenate([job.points, spots]),
        np.concatenate([rows, np.repeat(rows, job.candidates)]),
        screened(job.candidates),
    )


def land(model: "Model", landing: Landing) -> Landed:
    """The network's heads: put spots on their charts, give them normals. Runs on workers."""
    return model.land(landing)


def merge(job: Job, charts: Sequence[PatchCharts], candidates: Sequence[Landed]) -> list[Landing]:
    """Decide where the output points go; parcels of them, with the charts they land on."""
    atlas = bind(charts)
    if job.nothing_new:
        rows = np.flatnonzero(job.core).astype(np.int32)
        return _parcels(job, atlas, job.points[rows], rows, fixed=True)
    leads = [patch.core for patch in job.patches]
    own = Landed.join([part.take(slice(0, n)) for part, n in zip(candidates, leads, strict=True)])
    new = Landed.join(
        [part.take(slice(n, None)) for part, n in zip(candidates, leads, strict=True)]
    )
    moved = np.linalg.norm(own.points - job.points, axis=1) / job.frames.spacing
    pinned = None
    if job.tile.keeps_input or np.median(moved) < _EXACT:
        pinned = job.points, own.normals
    stay, spots, owner = place(
        new.points,
        new.normals,
        new.error,
        new.nearest,
        job.tile.n_out,
        shares(job.frames.spacing, job.neighbours),
        job.neighbours,
        job.tile.seed,
        pinned,
        job.core,
        all_stay=job.tile.keeps_input,
    )
    own_parcels = _parcels(job, atlas, job.points[stay], stay, fixed=True) if len(stay) else []
    return own_parcels + _parcels(job, atlas, spots, owner)


def _parcels(
    job: Job,
    atlas: Atlas,
    spots: NDArray[np.float64],
    owner: NDArray[np.int32],
    blended: int = BLENDED,
    *,
    fixed: bool = False,
) -> list[Landing]:
    ends = np.cumsum([patch.core for patch in job.patches])[:-1]
    return parcels(
        atlas, spots, owner, job.points, job.neighbours, job.frames, ends, blended, fixed=fixed
    )


def finish(job: Job, points: Sequence[Landed]) -> Piece:
    """Give normals their signs, carry colours and scalars over, put offset and scale back."""
    landed = Landed.join(points)
    tile, cloud = job.tile, job.cloud
    if tile.keeps_input:
        # The input's points lead; they landed in the order of the patches.
        own = np.argsort(job.order[job.core])
        landed = landed.take(np.append(own, np.arange(tile.core, tile.n_out)))
    elif job.frames.noise > _NOISY:
        share = shares(job.frames.spacing, job.neighbours)
        evened = even_out(
            landed.points, landed.normals, landed.nearest, share, job.neighbours, job.core
        )
        landed = replace(landed, points=evened)
    placement, axes = tile.placement, job.frames.axes[:, 2]
    graph = job.neighbours[:, :_TREE]
    sides = parts = None
    if tile.orient == "mst":
        sides = take_sides(tile.rows[job.order], job.core, job.points, axes, graph)
        normals = propagate(landed.normals, landed.nearest, sides.normals)
        parts = sides.parts[landed.nearest].astype(np.int32)
    elif tile.orient == "input":
        signs, _ = orient(job.points, axes, "input", None, cloud.normals, graph)
        normals = propagate(landed.normals, landed.nearest, signs)
    else:
        viewpoint = tile.viewpoint and placement.unit(tile.viewpoint)
        normals, _ = orient(
            landed.points, landed.normals, tile.orient, viewpoint, None, _NONE, tile.centroid
        )
    colors, scalars = carry(
        Cloud(job.points, colors=cloud.colors, scalars=cloud.scalars), landed.points
    )
    dense = Cloud(placement.world(landed.points), normals, colors, scalars)
    if tile.keeps_input:
        dense.points[: tile.core] = tile.cloud.points[: tile.core]
    return Piece(dense, parts, sides, job.frames.noise)


def agree(sides: Sequence[Sides | None]) -> list[Signs]:
    """Signs of each tile's parts, by which the normals of all point outward together."""
    known = [side for side in sides if side is not None]
    return list(signs_of_parts(known)) if known else [None] * len(sides)


def turn(piece: Piece, signs: Signs) -> Cloud:
    """Return the points of a tile, their normals' signs final."""
    if signs is None:
        return piece.cloud
    assert piece.cloud.normals is not None
    normals = piece.cloud.normals * signs[piece.parts, None].astype(np.float32)
    return replace(piece.cloud, normals=normals)


def assemble(plan: Plan, pieces: Sequence[Piece]) -> Result:
    """All tiles' points as one cloud."""
    signs = agree([piece.sides for piece in pieces])
    clouds = [turn(piece, sign) for piece, sign in zip(pieces, signs, strict=True)]
    dense = clouds[0] if len(clouds) == 1 else Cloud.join(clouds)
    if not plan.tiles_in_order:
        dense = dense.take(_input_first(plan.cuts))
    return Result(replace(dense, notes=plan.cloud.notes), plan.told(pieces[0].noise))


def _input_first(cuts: Sequence[Cut]) -> NDArray[np.int64]:
    """Rows of the joined pieces: the input's points in their order, then all that is new."""
    starts = np.cumsum([0] + [cut.n_out for cut in cuts])
    own, new = [], []
    for start, tile in zip(starts, cuts, strict=False):
        own.append(start + np.arange(tile.core))
        new.append(start + np.arange(tile.core, tile.n_out))
    back = np.argsort(np.concatenate([tile.rows[: tile.core] for tile in cuts]))
    return np.concatenate([np.concatenate(own)[back], *new])
