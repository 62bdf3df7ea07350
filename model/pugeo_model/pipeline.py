# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud: clean, normalise, patches, network, merge, finish.

    plan       = survey(cloud, options)
    for tile in plan.tiles:                       # one, unless the cloud is large
        job        = prepare(tile)
        charts     = [predict(model, patch, job.candidates) for patch in job.patches]
        if noisy(job):                            # once more, from where its points belong
            job    = denoise(job, land(model, own_spots(job, charts)))
            charts = [predict(model, patch, job.candidates) for patch in job.patches]
        candidates = land(model, propose(job, charts))
        points     = land(model, merge(job, charts, candidates))
        piece      = finish(job, points)
    result     = assemble(plan, pieces)

The stages are plain functions of plain data, so that the command line runs them in a row and the
service spreads tiles and ``predict`` over its workers; nothing else differs between the
two. Candidates land before the merge too: charts of their neighbours pull outliers in, and the
merge then spreads points that are where they seem to be.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.clean import clean
from pugeo_model.cloud import Cloud
from pugeo_model.finish.attributes import carry
from pugeo_model.finish.by_answer import take_sides_by_answer
from pugeo_model.finish.joining import signs_of_parts
from pugeo_model.finish.orientation import method_of, orient, propagate
from pugeo_model.finish.seams import Rim, part
from pugeo_model.geometry.chunks import PATCH_SIZE, chunks
from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.overlapping import overlapping_patches, patches_of
from pugeo_model.geometry.patches import cut
from pugeo_model.geometry.shares import shares
from pugeo_model.merge.atlas import (
    BLENDED,
    Atlas,
    Landed,
    Landing,
    PatchCharts,
    bind,
    screened,
)
from pugeo_model.merge.elimination import reach_of_share
from pugeo_model.merge.placement import even_out, nearest_charts, place
from pugeo_model.normalise import normalise
from pugeo_model.options import MOST, Options, refuse
from pugeo_model.plan import Agreed, Border, Job, Piece, Plan, Result
from pugeo_model.resample.overlap import PatchPoints, merge_overlapping
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
    "denoise",
    "finish",
    "land",
    "merge",
    "merge_patches",
    "noisy",
    "own_spots",
    "predict",
    "prepare",
    "propose",
    "settle",
    "survey",
]

# Spacings that half of the input's points move at most, when they land, of an input without noise:
# to 0.002 on clean and even validation inputs, to 0.023 on random ones, 0.04 to 0.18 with 1 %.
_EXACT = 0.03
# Spacings: even validation inputs with 1 % of noise have 0.11 to 0.28, with 2 % 0.2 to 0.4. Without
# any most have less, but much detail makes up to 0.22.
_NOISY = 0.1
_TREE = 12  # neighbours in the graph that hands signs of normals on: more cost time, mend little
_NONE = np.empty((0, 0), dtype=np.int32)


def survey(
    cloud: Cloud,
    options: Options,
    tile_size: int | None = None,
    patch_ratio: int | None = None,
) -> Plan:
    """Clean, normalise, cut into tiles.

    Args:
        cloud: the input.
        options: what is asked for.
        tile_size: input points of a tile at most; chosen by the size of its answer if ``None``.
        patch_ratio: R of a network that upsamples whole patches: no cloud gets more times its
            points. ``None`` where charts are predicted.

    Raises:
        UntreatableCloud: the points left after cleaning span no surface.
        BadOption: ``n_points`` is not 1 to 32 times the points left, or ``orient`` asks for what
            the cloud does not have.
    """
    cleaned, dropped = clean(cloud)
    points, placement = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    most = int(MOST) if patch_ratio is None else patch_ratio
    if not count <= n_out <= most * count:
        refuse(
            "n_points",
            n_out,
            f"from {count} to {most * count} (1 to {most} times the points left after cleaning)",
            limit=[count, most * count],
        )
    cuts, noise, typical = cut_tiles(points, n_out, tile_size)
    if noise is not None and noise > _NOISY and not options.keeps_points(count):
        # All points are to land, since others will lean on where they do.
        cuts = [replace(cut, charted=len(cut.rows)) for cut in cuts]
    given = cleaned.normals is not None
    method = method_of(options.orient, options.viewpoint, has_normals=given)
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "dropped": {"non_finite": dropped.non_finite, "duplicate": dropped.duplicate},
        "patches": sum(
            cut.patches if patch_ratio is None else patches_of(cut.charted) for cut in cuts
        ),
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
        spacing=typical,
        options=options,
        orient=method,
        n_out=n_out,
        report=report,
        patch_ratio=patch_ratio,
    )


def prepare(tile: Tile) -> Job:
    """Find neighbours and frames, cut patches."""
    # Rows in the order of the chunks: a patch's core is then a slice of every array to come.
    parts = chunks(tile.points[: tile.charted], PATCH_SIZE)
    order = np.concatenate([*parts, np.arange(tile.charted, len(tile.points), dtype=np.int32)])
    points = tile.points[order]
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances), tile.noise)
    ends = np.cumsum([0] + [len(part) for part in parts])
    patches: list[Any]
    if tile.patch_ratio is None:
        patches = [
            cut(np.arange(start, stop, dtype=np.int32), points, neighbours, frames)
            for start, stop in itertools.pairwise(ends)
        ]
    else:
        patches = overlapping_patches(points[: tile.charted])
    return Job(
        tile,
        tile.cloud.take(order),
        order,
        order < tile.core,
        points,
        neighbours,
        frames,
        shares(frames.spacing, neighbours, tile.spacing),
        patches,
        frames.noise,
    )


def noisy(job: Job) -> bool:
    """Whether the input's points may be off the surface, are free to move, and have not yet.

    Never for networks that upsample whole patches: there is no chart to move points onto.
    """
    if job.tile.patch_ratio is not None:
        return False
    return job.noise > _NOISY and not job.tile.keeps_input and not job.denoised


def predict(model: Any, patch: Any, candidates: int) -> Any:
    """The network: charts of a patch and what they propose, or its points. Runs on workers."""
    return model.charts(patch, candidates)


def own_spots(job: Job, charts: Sequence[PatchCharts]) -> Landing:
    """The input's points, with the charts they land on."""
    atlas = bind(job.points, job.frames, charts)
    return _landing(job, atlas, job.points[: job.tile.charted], _rows(job))


def denoise(job: Job, own: Landed) -> Job:
    """Prepare a noisy input anew, from where its points landed.

    Neighbours, frames and quadrics of points near the surface say more than those of noisy ones.
    What hardly moves is detail and no noise: its job stays as it is, and so do its charts.
    """
    if _exact(job, own):
        return job
    points = np.empty_like(job.points)
    points[job.order] = own.points
    again = prepare(replace(job.tile, points=points, noise=None))
    share = again.share
    if job.tile.spacing is not None:
        # What was typical of the whole cloud was so with its noise.
        change = np.median(again.frames.spacing) / np.median(job.frames.spacing)
        typical = float(job.tile.spacing * change)
        share = shares(again.frames.spacing, again.neighbours, typical)
    return replace(again, share=share, noise=job.noise, denoised=True)


def propose(job: Job, charts: Sequence[PatchCharts]) -> Landing:
    """The candidates of all charts, with the charts they land on.

    The input's points lead: where they land tells what they are worth.
    """
    rows, atlas = _rows(job), bind(job.points, job.frames, charts)
    if job.nothing_new:
        return _landing(job, atlas, job.points[:0], rows[:0])
    points = job.points[: job.tile.charted]
    spots = (points[:, None] + atlas.candidates).reshape(-1, 3)
    return _landing(
        job,
        atlas,
        np.concatenate([points, spots]),
        np.concatenate([rows, np.repeat(rows, job.candidates)]),
        blended=screened(job.candidates),
    )


def land(model: "Model", landing: Landing) -> Landed:
    """The network's heads: put spots on their charts, give them normals."""
    return model.land(landing)


def merge(job: Job, charts: Sequence[PatchCharts], candidates: Landed) -> Landing:
    """Decide where the output points go; those of the input that stay lead."""
    atlas = bind(job.points, job.frames, charts)
    if job.nothing_new:
        rows = np.flatnonzero(job.core).astype(np.int32)
        return _landing(job, atlas, job.points[rows], rows, fixed=len(rows))
    own = candidates.take(slice(0, job.tile.charted))
    new = candidates.take(slice(job.tile.charted, None))
    pinned = None
    if job.tile.keeps_input or (_exact(job, own) and not job.denoised):
        pinned = job.points[: job.tile.charted], own.normals
    stay, spots, owner = place(
        new.points,
        new.normals,
        new.error,
        new.nearest,
        job.tile.n_out,
        job.share,
        job.neighbours,
        job.tile.seed,
        pinned,
        job.core,
        job.tile.charted,
        all_stay=job.tile.keeps_input,
    )
    spots, owner = np.concatenate([job.points[stay], spots]), np.concatenate([stay, owner])
    return _landing(job, atlas, spots, owner, fixed=len(stay))


def _exact(job: Job, own: Landed) -> bool:
    """Whether the input's points were on the surface, by how little they move when they land."""
    count = len(own.points)
    moved = np.linalg.norm(own.points - job.points[:count], axis=1) / job.frames.spacing[:count]
    return bool(np.median(moved) < _EXACT)


def _rows(job: Job) -> NDArray[np.int32]:
    return np.arange(job.tile.charted, dtype=np.int32)


def _landing(
    job: Job,
    atlas: Atlas,
    spots: NDArray[np.float64],
    owner: NDArray[np.int32],
    *,
    blended: int = BLENDED,
    fixed: int = 0,
) -> Landing:
    near = nearest_charts(spots, owner, job.points, job.neighbours, blended, job.tile.charted)
    return Landing(atlas, spots, near, fixed)


def merge_patches(job: Job, patches: Sequence[PatchPoints]) -> Landed:
    """The output points of networks that upsample whole patches, by farthest-point sampling."""
    tile = job.tile
    return merge_overlapping(
        job.points, job.core, patches, tile.n_out, keeps_input=tile.keeps_input
    )


def finish(job: Job, landed: Landed) -> Piece:
    """Give normals their signs, carry colours and scalars over, put offset and scale back."""
    tile, cloud = job.tile, job.cloud
    if tile.keeps_input:
        # The input's points lead, in the order of the patches.
        own = np.argsort(job.order[job.core])
        landed = landed.take(np.append(own, np.arange(tile.core, tile.n_out)))
    elif job.denoised:
        evened = even_out(
            landed.points, landed.normals, landed.nearest, job.share, job.neighbours, job.core
        )
        landed = replace(landed, points=evened)
    placement, axes = tile.placement, job.frames.axes[:, 2]
    graph = job.neighbours[:, :_TREE]
    sides = parts = None
    if tile.orient == "mst":
        sides, signs, parts = take_sides_by_answer(
            tile.rows[job.order],
            job.core,
            job.points,
            axes,
            graph,
            job.share,
            (landed.points, landed.normals, landed.nearest),
        )
        normals = landed.normals * signs[:, None].astype(np.float32)
        # There are few, and the points of a large cloud are many.
        parts = parts.astype(np.min_scalar_type(parts.max()))
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
    rim = None if job.core.all() else _rim(job, landed)
    return Piece(dense, parts, Border(sides, rim), job.noise, placement)


def _rim(job: Job, landed: Landed) -> Rim:
    """The points whose charts have some of other tiles around them, or are such themselves."""
    inside = job.core[job.neighbours]
    around = job.core & inside.all(axis=1)
    rows = np.flatnonzero(~around[landed.nearest])
    owner = landed.nearest[rows]
    reach = reach_of_share(job.share * (job.tile.core / job.tile.n_out))[owner]
    if job.tile.keeps_input:
        reach[rows < job.tile.core] = 0.0
    outermost = ~(job.core & inside[:, :_TREE].all(axis=1))[owner]
    return Rim(rows.astype(np.int32), landed.points[rows], landed.normals[rows], reach, outermost)


def agree(borders: Sequence[Border]) -> list[Agreed]:
    """Let normals of all tiles point outward together, and part points that share a spot."""
    sides = [border.sides for border in borders if border.sides is not None]
    signs = signs_of_parts(sides) if sides else [None] * len(borders)
    # A part of the cloud that stands apart may be a tile by itself, without a rim.
    parted = iter(part([border.rim for border in borders if border.rim is not None]))
    places = [None if border.rim is None else next(parted) for border in borders]
    return [Agreed(*both) for both in zip(signs, places, strict=True)]


def settle(piece: Piece, agreed: Agreed) -> Cloud:
    """Return the points of a tile, final with their normals' signs."""
    cloud, rim = piece.cloud, piece.border.rim
    if rim is not None and agreed.rim is not None:
        moves = rim.reach > 0.0
        points = cloud.points.copy()
        points[rim.rows[moves]] = piece.placement.world(agreed.rim[moves])
        cloud = replace(cloud, points=points)
    if agreed.signs is not None:
        assert cloud.normals is not None
        normals = cloud.normals * agreed.signs[piece.parts, None].astype(np.float32)
        cloud = replace(cloud, normals=normals)
    return cloud


def assemble(plan: Plan, pieces: Sequence[Piece]) -> Result:
    """All tiles' points as one cloud."""
    agreed = agree([piece.border for piece in pieces])
    clouds = [settle(*both) for both in zip(pieces, agreed, strict=True)]
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
