# SPDX-License-Identifier: Apache-2.0
"""A cloud in tiles gives the same quality as in one piece."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pugeo_model import Cloud
from pugeo_model.denoise import needs_denoising
from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import Patch
from pugeo_model.local_stages import denoise
from pugeo_model.mesh.sampling import poisson_disk
from pugeo_model.metrics.clouds import evenness
from pugeo_model.options import Options
from pugeo_model.orient.across_tiles import signs_across_tiles
from pugeo_model.orient.dense import orient_dense
from pugeo_model.plan import make_plan
from pugeo_model.prepare import prepare
from pugeo_model.queries import propose
from pugeo_model.resample.atlas import Atlas
from pugeo_model.tiles import plan_tiles
from pugeo_model.upsampler import Upsampler

SIZE = 1200
SEAM = 0.1  # three and a half spacings of the dense balls


@pytest.fixture(scope="module")
def upsampler():
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


def even_ball(seed):
    """An even sphere of 4,000 points."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 121), np.linspace(0, np.pi, 61))
    at = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    rows = np.arange(121 * 61).reshape(61, 121)
    one, two, three, four = (
        part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[:-1, 1:], rows[1:, 1:])
    )
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([three, two, four], 1)])
    points = poisson_disk(at.reshape(-1, 3), faces, 4000, np.random.default_rng(seed))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def ball():
    """The first of the even spheres."""
    return even_ball(0)


def dense(upsampler, cloud, options, size=None):
    """Upsample a cloud in tiles of at most ``size`` points."""
    return upsampler.upsample(make_plan(cloud, options, size))


def predict(upsampler, prepared):
    """Charts of all patches."""
    count = prepared.tile.candidates
    return [upsampler.model.charts(patch, count) for patch in prepared.patches]


def test_cores_partition_the_cloud(ball):
    """Each point is in one core; margins contain all points near it; output counts add up."""
    specs, noise, typical = plan_tiles(ball, 16_001, SIZE)
    assert len(specs) == 4
    cores = [spec.rows[: spec.core] for spec in specs]
    np.testing.assert_array_equal(np.sort(np.concatenate(cores)), np.arange(4000))
    assert sum(spec.n_out for spec in specs) == 16_001
    assert noise is not None
    assert noise < 0.02
    spacing = nearest(ball)[0][:, :8].mean()
    assert typical == pytest.approx(spacing, rel=0.03)
    for spec in specs:
        distance = cKDTree(ball[spec.rows[: spec.core]]).query(ball)[0] / spacing
        assert set(np.flatnonzero(distance < 6)) <= set(spec.rows)
        # The inner margin gets charts, the outer one does not.
        assert set(np.flatnonzero(distance < 2.8)) <= set(spec.rows[: spec.charted])
        assert distance[spec.rows[: spec.charted]].max() < 3.6
        assert len(np.unique(spec.rows)) == len(spec.rows)


def test_small_clouds_stay_whole(ball):
    """A small cloud is a single tile, which measures noise and spacing itself."""
    specs, *measured = plan_tiles(ball, 16_000)
    assert [(spec.core, spec.n_out) for spec in specs] == [(4000, 16_000)]
    assert measured == [None, None]


def at_seams(points, tile):
    """Points within some spacings of a point of another tile."""
    near = np.empty(len(points))
    for number in np.unique(tile):
        own = tile == number
        near[own] = cKDTree(points[~own]).query(points[own])[0]
    return points[near < SEAM]


def closest_pairs(whole, tiled, seams):
    """Distances to the nearest point, sorted, of the points of both clouds at the seams.

    Inside a tile, chance may bring a pair closer, as in one piece.
    """
    tree = cKDTree(seams)
    for points in (whole, tiled):
        here = tree.query(points)[0] < SEAM / 4
        yield np.sort(np.ravel(cKDTree(points).query(points[here], k=[2])[0]))


@pytest.mark.slow
def test_no_seam_shows(upsampler):
    """Tiles are as even as one piece, without coincident points, with all normals outward."""
    ratios = []
    for seed in range(3):
        ball = Cloud(even_ball(seed))
        whole = dense(upsampler, ball, Options(4.0)).cloud
        plan = make_plan(ball, Options(4.0), SIZE)
        tiled = upsampler.upsample(plan).cloud
        assert len(tiled) == 16_000
        assert evenness(tiled.points) < 1.03 * evenness(whole.points)
        tile = np.repeat(np.arange(len(plan.tile_specs)), [spec.n_out for spec in plan.tile_specs])
        once, tiles = closest_pairs(whole.points, tiled.points, at_seams(tiled.points, tile))
        # Without the separation at the seams, 2 to 14 points of such a ball are as close to
        # another one as 0.13 of the smallest distance here.
        assert (tiles[:100] > 0.9 * once[:100]).all()
        ratios.append(tiles[:100] / once[:100])
        assert np.einsum("ij,ij->i", tiled.normals, tiled.points).min() > 0.9
        assert np.abs(np.linalg.norm(tiled.points, axis=1) - 1).max() < 5e-3
    # Rounding, which differs between processors, decides on the pairs of one ball, not on the mean.
    assert (np.mean(ratios, axis=0) > 0.95).all()


@pytest.mark.slow
def test_no_seam_shows_where_points_were_noisy(upsampler, ball):
    """Denoised tiles are as even and as near the surface as one piece."""
    noisy = ball + np.random.default_rng(0).normal(size=ball.shape, scale=0.01)
    whole = dense(upsampler, Cloud(noisy), Options(4.0)).cloud.points
    tiled = dense(upsampler, Cloud(noisy), Options(4.0), SIZE).cloud.points
    assert evenness(tiled) < 1.05 * evenness(whole)
    off = [np.abs(np.linalg.norm(each, axis=1) - 1).mean() for each in (whole, tiled)]
    assert off[1] < 1.05 * off[0] < 0.005


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_tiles_have_the_same_areas(upsampler, ball, scale):
    """All points of an even cloud have the same area, in each tile, denoised or not."""
    cloud = ball + np.random.default_rng(0).normal(size=ball.shape, scale=scale)
    for tile in make_plan(Cloud(cloud), Options(4.0), SIZE).tiles:
        prepared = prepare(tile)
        noisy = needs_denoising(prepared)
        assert noisy is (scale > 0)
        charted = sum(patch.core for patch in prepared.patches if isinstance(patch, Patch))
        # All points of a noisy cloud get charts, since the margin is denoised as well.
        assert charted == tile.charted
        assert (charted == len(prepared.points)) is noisy
        if noisy:
            moved = denoise(upsampler.model, prepared, predict(upsampler, prepared))
            assert moved is not None
            prepared = prepare(moved)
            assert prepared.tile.noisy is not None
        area = prepared.area[prepared.core]
        assert area.std() < 0.004 * area.mean()


def test_queries_use_charted_points_only(upsampler):
    """Points without charts are never used, though some are the nearest to a query."""
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((6000, 2)), rng.random((1400, 2)) * [5, 1] + [1, 0]
    flat = np.concatenate([dense, sparse])
    cloud = Cloud(np.column_stack([flat, 0.01 * flat[:, 0]]))
    without_chart = 0
    for tile in make_plan(cloud, Options(2.0), 1250).tiles:
        prepared = prepare(tile)
        charts = predict(upsampler, prepared)
        query = propose(prepared, Atlas.of(prepared.points, prepared.frames, charts))
        assert query.charts.max() < tile.charted == sum(len(each.rows) for each in charts)
        near = prepared.neighbours[query.charts[:, 0], :12]
        offsets = query.points[:, None] - prepared.points[near]
        closest = near[np.arange(len(near)), np.square(offsets).sum(axis=2).argmin(axis=1)]
        without_chart += int(np.count_nonzero(closest >= tile.charted))
    assert without_chart > 0


def test_a_noisy_cloud_that_is_kept(ball):
    """Margins get no more charts than usual, since kept input is not denoised."""
    noisy_ball = Cloud(ball + np.random.default_rng(0).normal(size=ball.shape, scale=0.02))
    for keep in (False, True):
        plan = make_plan(noisy_ball, Options(4.0, keep_input=keep), SIZE)
        assert all((spec.charted == len(spec.rows)) is not keep for spec in plan.tile_specs)


def test_a_tile_without_neighbours(upsampler, ball):
    """A tile far from all others has no border; the other tiles have one."""
    apart = np.concatenate([0.4 * ball[::4], ball + [50.0, 0.0, 0.0]])
    plan = make_plan(Cloud(apart), Options(2.0), 1000)
    margins = [len(spec.rows) - spec.core for spec in plan.tile_specs]
    assert min(margins) == 0 < max(margins)
    dense = upsampler.upsample(plan).cloud
    assert len(dense) == 10_000
    near = dense.points[:, 0] < 25
    centre = np.where(near[:, None], 0.0, [[50.0, 0.0, 0.0]])
    radius = np.linalg.norm(dense.points - centre, axis=1)
    assert np.abs(radius - np.where(near, 0.4, 1.0)).max() < 0.02


@pytest.mark.parametrize("ratio", [1.0, 1.01, 2.5])
def test_the_input_is_kept(upsampler, ball, ratio):
    """Kept input is unchanged and in its order, though its points come from several tiles."""
    height = ball[:, 2].astype(np.float32)
    cloud = Cloud(ball, scalars={"height": height})
    result = dense(upsampler, cloud, Options(ratio, keep_input=True), SIZE)
    assert len(result.cloud) == int(np.floor(ratio * 4000 + 0.5))
    assert result.cloud.points[:4000].tobytes() == ball.tobytes()
    np.testing.assert_array_equal(result.cloud.scalars["height"][:4000], height)
    inward = np.einsum("ij,ij->i", result.cloud.normals, result.cloud.points) < 0
    assert not inward.any()
    assert result.report["tiles"] == 4


@pytest.mark.parametrize("orient", ["viewpoint", "outward", "input", "none"])
def test_signs_that_need_no_neighbours(upsampler, ball, orient):
    """Each method gives the same signs in tiles, far from the origin too."""
    offset = np.array([5e5, 1e6, 30.0])
    cloud = Cloud(ball + offset, normals=(-ball).astype(np.float32))
    options = Options(2.0, orient=orient, viewpoint=tuple(offset))
    result = dense(upsampler, cloud, options, SIZE)
    outside = np.einsum("ij,ij->i", result.cloud.normals, result.cloud.points - offset) > 0
    expected = {"viewpoint": 0.0, "outward": 1.0, "input": 0.0}
    if orient in expected:
        assert outside.mean() == expected[orient]
    assert result.report["orient"] == orient


def test_progress_counts_all_tiles(upsampler, ball):
    """The number of completed patches never decreases and ends at the total."""
    calls = []
    plan = make_plan(Cloud(ball), Options(2.0), SIZE)
    upsampler.upsample(plan, lambda *call: calls.append(call))
    done = [done for stage, done, _ in calls if stage == "predict"]
    assert done == sorted(done)
    assert len(set(done)) >= len(plan.tile_specs)
    assert {total for _, _, total in calls} == {plan.report["patches"]}
    assert calls[-1][1] == plan.report["patches"]


def test_signs_across_tiles():
    """Tiles with random signs become consistent and outward, for two separate shells."""
    rng = np.random.default_rng(3)
    shells = [rng.normal(size=(1500, 3)) for _ in range(2)]
    shells = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in shells]
    points = np.concatenate([shells[0], 0.3 * shells[1] + [4.0, 0, 0]])
    true = np.concatenate(shells)
    order = rng.permutation(3000)
    points, true = points[order], true[order]
    tiles = []
    for spec in plan_tiles(points, 3000, 500)[0]:
        rows = spec.rows
        mixed = true[rows] * rng.choice([-1.0, 1.0], (len(rows), 1))
        core = np.arange(len(rows)) < spec.core
        distances, near = nearest(points[rows])
        near = np.ascontiguousarray(near[:, :12])
        area = surface_areas(spacing(distances), near)
        mixed = mixed.astype(np.float32)
        owner = np.arange(spec.core, dtype=np.int32)
        output = points[rows[: spec.core]], mixed[: spec.core], owner
        tiles.append(orient_dense(rows, core, points[rows], mixed, near, area, output)[0])
    assert len(tiles) > 4
    for tile, signs in zip(tiles, signs_across_tiles(tiles), strict=True):
        oriented = tile.normals * signs[tile.parts, None]
        assert (np.einsum("ij,ij->i", oriented, true[tile.rows])[tile.core] > 0).mean() > 0.99
