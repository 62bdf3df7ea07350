# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pugeo_model import BadOptionError, Cloud, UntreatableCloudError
from pugeo_model.metrics.clouds import evenness
from pugeo_model.options import Options
from pugeo_model.pipeline import (
    assemble,
    denoise,
    finish,
    input_queries,
    land,
    make_plan,
    merge,
    noisy,
    predict,
    prepare,
    propose,
)
from pugeo_model.upsampler import Upsampler


@pytest.fixture(scope="module")
def upsampler():
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


@pytest.mark.parametrize("ratio", [1.5, 4, 7.3, 16, 32])
def test_exact_counts_on_a_sphere(upsampler, sphere, ratio):
    """Any real ratio gives exactly round(R M) points, on the sphere, with its normals."""
    points = sphere[:: max(1, int(ratio) // 8)]
    dense = upsampler(points, ratio).cloud
    assert len(dense) == int(np.floor(ratio * len(points) + 0.5))
    radius = np.linalg.norm(dense.points, axis=1)
    unit = dense.points / radius[:, None]
    np.testing.assert_allclose(np.linalg.norm(dense.normals, axis=1), 1, atol=1e-5)
    if len(points) == len(sphere):
        assert np.abs(radius - 1).mean() < 2e-3
        assert np.degrees(np.arccos((dense.normals * unit).sum(1).clip(-1, 1))).mean() < 5


def test_even_spacing(upsampler, sphere):
    """The dense points are spread about as evenly as a Poisson-disk sample."""
    assert evenness(upsampler(sphere, 4).cloud.points) < 0.13


def test_plane_stays_flat(upsampler, plane):
    """Points of a plane stay in it, with its normal."""
    points, normal = plane
    dense = upsampler(points, 4).cloud
    assert np.abs(dense.points @ normal).mean() < 1e-3
    assert np.abs(dense.normals @ normal).mean() > 0.995


def test_cube_keeps_its_faces(upsampler, cube):
    """Dense points of a cube lie on its faces, not across its edges."""
    dense = upsampler(cube[0], 4).cloud.points
    off = np.abs(np.abs(dense - 0.5).max(axis=1) - 0.5)
    assert off.mean() < 3e-3


def test_ratio_one_returns_the_input_with_normals(upsampler, sphere):
    """At R=1 the points are the input's own, bit for bit and in order."""
    points = sphere.astype(np.float32)
    dense = upsampler(points, 1).cloud
    np.testing.assert_array_equal(dense.points, points)
    assert (dense.normals * dense.points).sum(axis=1).mean() > 0.99


def test_the_input_can_be_kept(upsampler, sphere):
    """Kept input leads the answer bit for bit, noise and all; new points spread evenly around."""
    noisy = (sphere + np.random.default_rng(0).normal(0, 0.01, sphere.shape)).astype(np.float32)
    cloud = Cloud(noisy, scalars={"row": np.arange(len(noisy), dtype=np.int32)})
    dense = upsampler(cloud, 3, keep_input=True).cloud
    count = len(noisy)
    assert len(dense) == 3 * count
    np.testing.assert_array_equal(dense.points[:count], noisy)
    np.testing.assert_array_equal(dense.scalars["row"][:count], np.arange(count))
    off = np.abs(np.linalg.norm(dense.points, axis=1) - 1)
    assert off[count:].mean() < 0.8 * off[:count].mean()
    assert evenness(dense.points) < 0.25
    assert (dense.normals * dense.points).sum(axis=1).mean() > 0.95


def test_n_points_instead_of_ratio(upsampler, sphere):
    """A number of points is met exactly; outside 1 to 32 times the input it is refused."""
    assert len(upsampler(sphere, n_points=5001).cloud) == 5001
    for wanted in (10, 100_000):
        with pytest.raises(BadOptionError, match="n_points"):
            upsampler(sphere, n_points=wanted)


def test_order_of_work_does_not_matter(upsampler, sphere):
    """Patches predicted in any order, by anyone, give the same bytes."""
    points = np.concatenate([sphere, sphere + [2.5, 0, 0], sphere * 1.1 + [0, 2.5, 0]])
    plan = make_plan(Cloud(points), Options(4.0))
    job = prepare(plan.tile(0))
    assert len(job.patches) > 2
    model = upsampler.model
    results = []
    for turn in (1, -1):
        charts = [predict(model, patch, job.candidates) for patch in job.patches[::turn]]
        candidates = land(model, propose(job, charts))
        piece = finish(job, land(model, merge(job, charts, candidates)))
        results.append(assemble(plan, [piece]))
    one, two = results
    assert one.cloud.points.tobytes() == two.cloud.points.tobytes()
    np.testing.assert_array_equal(one.cloud.normals, two.cloud.normals)


def test_seed_decides(upsampler, sphere):
    """The same seed gives the same bytes, another seed another sample as good."""
    same = [upsampler(sphere, 4, seed=7).cloud.points.tobytes() for _ in range(2)]
    other = upsampler(sphere, 4, seed=8).cloud.points
    assert same[0] == same[1] != other.tobytes()
    assert evenness(other) < 0.13


def test_large_offset_in_double(upsampler, sphere):
    """A scan far from the origin is upsampled as well as one at it."""
    far = np.array([4.3e5, 5.4e6, 600.0])
    here = upsampler(sphere, 2).cloud.points
    there = upsampler(sphere + far, 2).cloud.points - far
    assert np.abs(np.linalg.norm(there, axis=1) - 1).mean() < 2e-3
    assert np.abs(np.linalg.norm(here, axis=1) - 1).mean() < 2e-3


def test_attributes_ride_along(upsampler, sphere):
    """Colours and scalars are interpolated, labels taken from the nearest point."""
    level = ((sphere[:, 2] + 1) * 127).astype(np.uint8)
    cloud = Cloud(
        sphere,
        colors=np.stack([level, 255 - level, level], axis=1),
        scalars={"height": sphere[:, 2].copy(), "side": (sphere[:, 2] > 0).astype(np.int32)},
    )
    dense = upsampler(cloud, 3).cloud
    assert dense.colors.dtype == np.uint8
    assert np.abs(dense.scalars["height"] - dense.points[:, 2]).mean() < 0.02
    assert set(np.unique(dense.scalars["side"])) == {0, 1}


def test_every_normal_faces_the_viewpoint(upsampler, sphere):
    """With a viewpoint no dense normal looks away from it, however the surface lies."""
    where = (0.3, 0.2, 1.4)
    for ratio in (1, 4):
        result = upsampler(sphere, ratio, viewpoint=where)
        assert result.report["orient"] == "viewpoint"
        facing = (result.cloud.normals * (np.array(where) - result.cloud.points)).sum(axis=1)
        assert facing.min() > -1e-6


def test_nothing_flies_off(upsampler):
    """However scattered the input, no point lies further than 1.25 spacings from it."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * np.exp(rng.normal(size=(400, 1)))
    dense = upsampler(points, 8).cloud.points
    apart = np.linalg.norm(dense[:, None] - points[None], axis=-1)
    between = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    spacing = between[:, 1:9].mean(axis=1)
    assert (apart / spacing).min(axis=1).max() < 1.25 + 1e-6


def test_dropped_points_are_counted(upsampler, sphere):
    """NaN rows and duplicates go, the report says how many, and the count follows what is left."""
    dirty = np.concatenate([sphere, sphere[:5], np.full((3, 3), np.nan)])
    result = upsampler(dirty, 2)
    assert result.report["dropped"] == {"non_finite": 3, "duplicate": 5}
    assert len(result.cloud) == 2 * len(sphere)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1000, 3)),
        np.eye(3),
        np.linspace(0, 1, 50)[:, None] * [1.0, 1.0, 0.0],
        np.full((20, 3), np.inf),
        np.zeros((0, 3)),
    ],
    ids=["identical", "three", "line", "infinite", "none"],
)
def test_untreatable_clouds(upsampler, points):
    """What spans no surface is refused with a reason."""
    with pytest.raises(UntreatableCloudError):
        upsampler(points, 4)


@pytest.mark.parametrize(
    "options",
    [
        {"ratio": 0},
        {"ratio": 1e9},
        {"ratio": float("nan")},
        {"orient": "sideways"},
        {"orient": "viewpoint"},
        {"viewpoint": (0.0, float("inf"), 0.0)},
        {"seed": -1},
        {"n_points": 0},
    ],
)
def test_bad_options(options):
    """Each option out of range is refused by name."""
    with pytest.raises(BadOptionError) as caught:
        Options(**options)
    assert caught.value.fields["parameter"] in {*options, "viewpoint"}


@pytest.mark.parametrize("count", [8, 9, 20, 33, 40])
def test_tiny_clouds(upsampler, count):
    """From 8 points on every cloud is answered, with finite points and unit normals."""
    points = np.random.default_rng(count).random((count, 3))
    dense = upsampler(points, 4).cloud
    assert len(dense) == 4 * count
    assert np.isfinite(dense.points).all()
    np.testing.assert_allclose(np.linalg.norm(dense.normals, axis=1), 1, atol=1e-4)


def test_nearly_duplicate_points(upsampler, sphere):
    """Points 1e-12 apart do not blow anything up."""
    close = np.concatenate([sphere, sphere[:500] + 1e-12])
    dense = upsampler(close, 4).cloud
    assert np.isfinite(dense.points).all()
    assert np.abs(np.linalg.norm(dense.points, axis=1) - 1).mean() < 0.02


def test_points_of_a_clean_input_may_stay(upsampler, sphere):
    """Where they survive beside the candidates, as on a tip that no chart reaches; not if noisy."""
    tip = np.array([[0.0, 0.0, 1.12]])
    spiked = np.concatenate([sphere, tip])
    noise = np.random.default_rng(0).normal(size=spiked.shape, scale=0.01)
    for points, stays in ((spiked, True), (spiked + noise, False)):
        dense = upsampler(points, 4).cloud.points
        apart = np.min(cKDTree(dense).query(points[-1])[0])
        assert bool(apart < 1e-9) is stays
        assert evenness(dense) < 0.12


def test_a_noisy_input_is_denoised_first(upsampler, sphere):
    """Its job is prepared anew, from points nearer to the surface; the report tells of the input.

    One without noise, or whose points are to stay, goes its way as it is.
    """
    points = sphere + np.random.default_rng(0).normal(size=sphere.shape, scale=0.02)
    for cloud, keep, moves in (
        (points, False, True),
        (points, True, False),
        (sphere, False, False),
    ):
        (tile,) = make_plan(Cloud(cloud), Options(4.0, keep_input=keep)).tiles
        job = prepare(tile)
        assert noisy(job) is moves
        if moves:
            charts = [predict(upsampler.model, patch, job.candidates) for patch in job.patches]
            again = denoise(job, land(upsampler.model, input_queries(job, charts)))
            placed = [tile.placement.world(each.points) for each in (job, again)]
            off = [np.abs(np.linalg.norm(each, axis=1) - 1).mean() for each in placed]
            assert off[1] < 0.7 * off[0]
            assert again.frames.noise < job.frames.noise == again.noise
            assert upsampler(cloud, 4).report["noise"] == job.noise


def test_detail_is_not_taken_for_noise(upsampler):
    """What looks rough but lands where it is stays: a cloud too coarse for its folds."""
    u, v = np.random.default_rng(0).random((2, 1500)) * 30
    folds = np.column_stack([u, v, 0.8 * np.abs((u + 0.3 * v) % 4 - 2)])
    (tile,) = make_plan(Cloud(folds), Options(4.0)).tiles
    job = prepare(tile)
    charts = [predict(upsampler.model, patch, job.candidates) for patch in job.patches]
    again = denoise(job, land(upsampler.model, input_queries(job, charts)))
    assert noisy(job)
    assert again is job
