# SPDX-License-Identifier: Apache-2.0
"""A cloud in tiles comes out as it would in one piece."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pugeo_model import Cloud
from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.metrics.clouds import evenness
from pugeo_model.options import Options
from pugeo_model.orient.across_tiles import signs_across_tiles
from pugeo_model.orient.dense import orient_dense
from pugeo_model.pipeline import (
    denoise,
    input_queries,
    land,
    make_plan,
    noisy,
    predict,
    prepare,
    propose,
)
from pugeo_model.tiles import plan_tiles
from pugeo_model.training.corpus import poisson_disk
from pugeo_model.upsampler import Upsampler

SIZE = 1200


@pytest.fixture(scope="module")
def upsampler():
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


@pytest.fixture(scope="module")
def ball():
    """An even sphere of 4,000 points."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 121), np.linspace(0, np.pi, 61))
    at = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    rows = np.arange(121 * 61).reshape(61, 121)
    one, two, three, four = (
        part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[:-1, 1:], rows[1:, 1:])
    )
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([three, two, four], 1)])
    points = poisson_disk(at.reshape(-1, 3), faces, 4000, np.random.default_rng(0))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def dense(upsampler, cloud, options, size=None):
    """The whole way, in tiles of at most ``size``."""
    return upsampler.upsample(make_plan(cloud, options, size))


def test_cores_partition_the_cloud(ball):
    """Every point is in one core; margins hold all within reach; surface_areas of the answer add up."""
    cuts, noise, typical = plan_tiles(ball, 16_001, SIZE)
    assert len(cuts) == 4
    cores = [cut.rows[: cut.core] for cut in cuts]
    np.testing.assert_array_equal(np.sort(np.concatenate(cores)), np.arange(4000))
    assert sum(cut.n_out for cut in cuts) == 16_001
    assert noise is not None
    assert noise < 0.02
    spacing = nearest(ball)[0][:, :8].mean()
    assert typical == pytest.approx(spacing, rel=0.03)
    for cut in cuts:
        apart = cKDTree(ball[cut.rows[: cut.core]]).query(ball)[0] / spacing
        assert set(np.flatnonzero(apart < 6)) <= set(cut.rows)
        # Those next to the core get charts, those beyond do not.
        assert set(np.flatnonzero(apart < 2.8)) <= set(cut.rows[: cut.charted])
        assert apart[cut.rows[: cut.charted]].max() < 3.6
        assert len(np.unique(cut.rows)) == len(cut.rows)


def test_small_clouds_stay_whole(ball):
    """A margin that costs more than it saves is not made."""
    cuts, *found = plan_tiles(ball, 16_000)
    assert [(cut.core, cut.n_out) for cut in cuts] == [(4000, 16_000)]
    assert found == [None, None]


def test_no_seam_shows(upsampler, ball):
    """As even as in one piece, nowhere two points on top of each other, all normals outward."""
    whole = dense(upsampler, Cloud(ball), Options(4.0)).cloud
    tiled = dense(upsampler, Cloud(ball), Options(4.0), SIZE).cloud
    assert len(tiled) == 16_000
    assert evenness(tiled.points) < 1.03 * evenness(whole.points)
    once, tiles = (
        np.sort(np.ravel(cKDTree(c.points).query(c.points, k=[2])[0])) for c in (whole, tiled)
    )
    # Each tile thins its own: without a look across the border two to fourteen points of such a
    # ball are as near to another as 0.13 of the closest here.
    assert tiles[0] > 0.9 * once[0]
    assert (tiles[2:100] > 0.95 * once[2:100]).all()
    assert np.einsum("ij,ij->i", tiled.normals, tiled.points).min() > 0.9
    assert np.abs(np.linalg.norm(tiled.points, axis=1) - 1).max() < 5e-3


def test_no_seam_shows_where_points_were_noisy(upsampler, ball):
    """Tiles denoise for themselves, and agree: as even and as near the surface as in one piece."""
    noisy = ball + np.random.default_rng(0).normal(size=ball.shape, scale=0.01)
    whole = dense(upsampler, Cloud(noisy), Options(4.0)).cloud.points
    tiled = dense(upsampler, Cloud(noisy), Options(4.0), SIZE).cloud.points
    assert evenness(tiled) < 1.05 * evenness(whole)
    off = [np.abs(np.linalg.norm(each, axis=1) - 1).mean() for each in (whole, tiled)]
    assert off[1] < 1.05 * off[0] < 0.005


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_tiles_take_the_same_for_accidents(upsampler, ball, scale):
    """Of an even cloud all points stand for the same area, in each tile, denoised or not."""
    cloud = ball + np.random.default_rng(0).normal(size=ball.shape, scale=scale)
    for tile in make_plan(Cloud(cloud), Options(4.0), SIZE).tiles:
        job = prepare(tile)
        assert noisy(job) is (scale > 0)
        charted = sum(patch.core for patch in job.patches)
        # Of a noisy cloud all points land, since others lean on where they do.
        assert charted == tile.charted
        assert (charted == len(job.points)) is noisy(job)
        if noisy(job):
            charts = [predict(upsampler.model, patch, job.candidates) for patch in job.patches]
            job = denoise(job, land(upsampler.model, input_queries(job, charts)))
            assert job.denoised
        share = job.share[job.core]
        assert share.std() < 0.004 * share.mean()


def test_spots_land_on_charts_alone(upsampler):
    """Where a border is sparser than the core, points without charts are the nearest to some."""
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((6000, 2)), rng.random((1400, 2)) * [5, 1] + [1, 0]
    flat = np.concatenate([dense, sparse])
    reached = []
    for tile in make_plan(
        Cloud(np.column_stack([flat, 0.01 * flat[:, 0]])), Options(2.0), 1250
    ).tiles:
        job = prepare(tile)
        charts = [predict(upsampler.model, patch, job.candidates) for patch in job.patches]
        landing = propose(job, charts)
        assert landing.charts.max() < tile.charted == sum(len(each.rows) for each in charts)
        near = job.neighbours[landing.charts[:, 0], :12]
        gaps = landing.spots[:, None] - job.points[near]
        nearest = near[np.arange(len(near)), np.square(gaps).sum(axis=2).argmin(axis=1)]
        reached.append(np.count_nonzero(nearest >= tile.charted))
    assert sum(reached) > 0


def test_a_noisy_cloud_whose_points_stay(ball):
    """Its margins need no more charts than others: nothing is denoised."""
    noisy_ball = Cloud(ball + np.random.default_rng(0).normal(size=ball.shape, scale=0.02))
    for keep in (False, True):
        plan = make_plan(noisy_ball, Options(4.0, keep_input=keep), SIZE)
        assert all((cut.charted == len(cut.rows)) is not keep for cut in plan.cuts)


def test_a_tile_without_neighbours(upsampler, ball):
    """A part of the cloud that stands apart and is one tile has no border; the others have."""
    apart = np.concatenate([0.4 * ball[::4], ball + [50.0, 0.0, 0.0]])
    plan = make_plan(Cloud(apart), Options(2.0), 1000)
    margins = [len(cut.rows) - cut.core for cut in plan.cuts]
    assert min(margins) == 0 < max(margins)
    dense = upsampler.upsample(plan).cloud
    assert len(dense) == 10_000
    near = dense.points[:, 0] < 25
    centre = np.where(near[:, None], 0.0, [[50.0, 0.0, 0.0]])
    radius = np.linalg.norm(dense.points - centre, axis=1)
    assert np.abs(radius - np.where(near, 0.4, 1.0)).max() < 0.02


@pytest.mark.parametrize("ratio", [1.0, 1.01, 2.5])
def test_the_input_is_kept(upsampler, ball, ratio):
    """Bit for bit and in its order, whatever tile a point was in; the rest lies between."""
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
    """Each method means the same in tiles, far from the origin too."""
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
    """A stage starts where it ended in the tile before, and all end at the total."""
    told = []
    plan = make_plan(Cloud(ball), Options(2.0), SIZE)
    upsampler.upsample(plan, lambda *now: told.append(now))
    done = [now for stage, now, _ in told if stage == "network"]
    assert done == sorted(done)
    assert len(set(done)) >= len(plan.cuts)
    assert {total for _, _, total in told} == {plan.report["patches"]}
    assert told[-1][1] == plan.report["patches"]


def test_signs_across_tiles():
    """Tiles that contradict each other are turned over until all agree; parts stay apart."""
    rng = np.random.default_rng(3)
    shells = [rng.normal(size=(1500, 3)) for _ in range(2)]
    shells = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in shells]
    points = np.concatenate([shells[0], 0.3 * shells[1] + [4.0, 0, 0]])
    true = np.concatenate(shells)
    order = rng.permutation(3000)
    points, true = points[order], true[order]
    sides = []
    for cut in plan_tiles(points, 3000, 500)[0]:
        rows = cut.rows
        mixed = true[rows] * rng.choice([-1.0, 1.0], (len(rows), 1))
        core = np.arange(len(rows)) < cut.core
        distances, near = nearest(points[rows])
        near = np.ascontiguousarray(near[:, :12])
        share = surface_areas(spacing(distances), near)
        mixed = mixed.astype(np.float32)
        answer = points[rows[: cut.core]], mixed[: cut.core], np.arange(cut.core, dtype=np.int32)
        sides.append(orient_dense(rows, core, points[rows], mixed, near, share, answer)[0])
    assert len(sides) > 4
    for side, signs in zip(sides, signs_across_tiles(sides), strict=True):
        agreed = side.normals * signs[side.parts, None]
        assert (np.einsum("ij,ij->i", agreed, true[side.rows])[side.core] > 0).mean() > 0.99
