# SPDX-License-Identifier: Apache-2.0
"""Upsampling of whole clouds, and the order of its stages."""

from collections.abc import Generator
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pugeo_model import BadOptionError, Cloud, UntreatableCloudError
from pugeo_model.assembly import assemble
from pugeo_model.denoise import needs_denoising
from pugeo_model.local_stages import denoise, densify
from pugeo_model.metrics.clouds import evenness
from pugeo_model.options import Options
from pugeo_model.pipeline import run_here, upsample_tile
from pugeo_model.plan import make_plan
from pugeo_model.prepare import prepare
from pugeo_model.stage_times import StageTimes
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
    """The spacing of dense points varies little more than that of a Poisson-disk sample."""
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
    """At R=1 the points are those of the input, bit for bit and in order."""
    points = sphere.astype(np.float32)
    dense = upsampler(points, 1).cloud
    np.testing.assert_array_equal(dense.points, points)
    assert (dense.normals * dense.points).sum(axis=1).mean() > 0.99


def test_the_input_can_be_kept(upsampler, sphere):
    """Kept noisy input leads the output bit for bit; the new points are denoised and even."""
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
    """A number of points is matched exactly; outside 1 to 32 times the input it is an error."""
    assert len(upsampler(sphere, n_points=5001).cloud) == 5001
    for wanted in (10, 100_000):
        with pytest.raises(BadOptionError, match="n_points"):
            upsampler(sphere, n_points=wanted)


def predict(upsampler, prepared, step=1):
    """Charts of all patches, in their order or in the opposite one."""
    count = prepared.tile.candidates
    return [upsampler.model.charts(patch, count) for patch in prepared.patches[::step]]


def test_order_of_work_does_not_matter(upsampler, sphere):
    """Patches predicted in any order give the same bytes."""
    points = np.concatenate([sphere, sphere + [2.5, 0, 0], sphere * 1.1 + [0, 2.5, 0]])
    plan = make_plan(Cloud(points), Options(4.0))
    prepared = prepare(plan.tile(0))
    assert len(prepared.patches) > 2
    results = []
    for step in (1, -1):
        charts = predict(upsampler, prepared, step)
        tile = densify(upsampler.model, prepared, charts, StageTimes())
        results.append(assemble(plan, [tile]))
    one, two = results
    assert one.cloud.points.tobytes() == two.cloud.points.tobytes()
    np.testing.assert_array_equal(one.cloud.normals, two.cloud.normals)


def test_seed_decides(upsampler, sphere):
    """The same seed gives the same bytes, another seed another sample that is as even."""
    same = [upsampler(sphere, 4, seed=7).cloud.points.tobytes() for _ in range(2)]
    other = upsampler(sphere, 4, seed=8).cloud.points
    assert same[0] == same[1] != other.tobytes()
    assert evenness(other) < 0.13


def test_large_offset_in_double(upsampler, sphere):
    """A scan far from the origin is upsampled as accurately as one at the origin."""
    far = np.array([4.3e5, 5.4e6, 600.0])
    here = upsampler(sphere, 2).cloud.points
    there = upsampler(sphere + far, 2).cloud.points - far
    assert np.abs(np.linalg.norm(there, axis=1) - 1).mean() < 2e-3
    assert np.abs(np.linalg.norm(here, axis=1) - 1).mean() < 2e-3


def test_attributes_are_interpolated(upsampler, sphere):
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
    """With a viewpoint no dense normal points away from it."""
    where = (0.3, 0.2, 1.4)
    for ratio in (1, 4):
        result = upsampler(sphere, ratio, viewpoint=where)
        assert result.report["orient"] == "viewpoint"
        facing = (result.cloud.normals * (np.array(where) - result.cloud.points)).sum(axis=1)
        assert facing.min() > -1e-6


def test_points_stay_near_the_input(upsampler):
    """No dense point lies further than 1.25 spacings from scattered input."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * np.exp(rng.normal(size=(400, 1)))
    dense = upsampler(points, 8).cloud.points
    distance = np.linalg.norm(dense[:, None] - points[None], axis=-1)
    between = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    spacing = between[:, 1:9].mean(axis=1)
    assert (distance / spacing).min(axis=1).max() < 1.25 + 1e-6


def test_dropped_points_are_counted(upsampler, sphere):
    """The report has the numbers of NaN rows and duplicates; the ratio refers to the others."""
    dirty = np.concatenate([sphere, sphere[:5], np.full((3, 3), np.nan)])
    result = upsampler(dirty, 2)
    assert result.report["dropped"] == {"non_finite": 3, "wild": 0, "duplicate": 5}
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
    """Points that span no surface are an error."""
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
        {"ratio": "4"},
        {"spacing": "0.1"},
        {"max_gap": [1.0]},
        {"viewpoint": "top"},
        {"viewpoint": (1.0, 2.0)},
        {"viewpoint": (1.0, (2.0, 3.0), 4.0)},
    ],
)
def test_bad_options(options):
    """An option out of range is an error with its name."""
    with pytest.raises(BadOptionError) as caught:
        Options(**options)
    assert caught.value.fields["parameter"] in {*options, "viewpoint"}


@pytest.mark.parametrize("spacing", [1e300, 1e155, 1e-170, 5e-324])
def test_spacings_beyond_all_numbers(sphere, spacing):
    """A spacing whose square is no number is refused, with the spacings that there can be."""
    with pytest.raises(BadOptionError, match="spacing must be from"):
        make_plan(Cloud(sphere), Options(spacing=spacing))


def test_viewpoints_in_an_array():
    """Positions are those of the rows; none are as if the option were left out."""
    places: Any = np.array([[0, 0, 9], [0, 0, -9]], dtype=np.float32)
    assert Options(viewpoint=places).viewpoints == ((0.0, 0.0, 9.0), (0.0, 0.0, -9.0))
    assert Options(viewpoint=places[0]).viewpoints == ((0.0, 0.0, 9.0),)
    assert Options(viewpoint=()).viewpoints == ()


@pytest.mark.parametrize("scale", [1e-60, 1e50])
def test_expected_errors_at_any_scale(upsampler, sphere, scale):
    """The expected error is a positive number where float32 has none of that size."""
    dense = upsampler(sphere.astype(np.float64) * scale, 2, confidence=True).cloud
    error = dense.scalars["expected_error"] / scale
    assert np.isfinite(error).all()
    assert error.min() > 0


@pytest.mark.parametrize("count", [8, 9, 20, 33, 40])
def test_tiny_clouds(upsampler, count):
    """Clouds of 8 points and more give finite points and unit normals."""
    points = np.random.default_rng(count).random((count, 3))
    dense = upsampler(points, 4).cloud
    assert len(dense) == 4 * count
    assert np.isfinite(dense.points).all()
    np.testing.assert_allclose(np.linalg.norm(dense.normals, axis=1), 1, atol=1e-4)


def test_nearly_duplicate_points(upsampler, sphere):
    """Points 1e-12 apart give finite points near the surface."""
    close = np.concatenate([sphere, sphere[:500] + 1e-12])
    dense = upsampler(close, 4).cloud
    assert np.isfinite(dense.points).all()
    assert np.abs(np.linalg.norm(dense.points, axis=1) - 1).mean() < 0.02


def test_points_of_a_clean_input_may_stay(upsampler, sphere):
    """Input points are candidates too, so that a tip is kept; not those of a noisy input."""
    tip = np.array([[0.0, 0.0, 1.05]])
    spiked = np.concatenate([sphere, tip])
    noise = np.random.default_rng(0).normal(size=spiked.shape, scale=0.01)
    for points, kept in ((spiked, True), (spiked + noise, False)):
        dense = upsampler(points, 4).cloud.points
        distance = np.min(cKDTree(dense).query(points[-1])[0])
        assert bool(distance < 1e-9) is kept
        assert evenness(dense) < 0.12


def test_a_noisy_input_is_denoised_first(upsampler, sphere):
    """A noisy tile is prepared again from points nearer to the surface, with the input's noise.

    Input without noise, and input that is kept, is not denoised.
    """
    points = sphere + np.random.default_rng(0).normal(size=sphere.shape, scale=0.02)
    for cloud, keep, moves in (
        (points, False, True),
        (points, True, False),
        (sphere, False, False),
    ):
        (tile,) = make_plan(Cloud(cloud), Options(4.0, keep_input=keep)).tiles
        prepared = prepare(tile)
        assert needs_denoising(prepared) is moves
        if moves:
            moved = denoise(upsampler.model, prepared, predict(upsampler, prepared))
            assert moved is not None
            again = prepare(moved)
            world = [tile.normalisation.world(each.points) for each in (prepared, again)]
            off = [np.abs(np.linalg.norm(each, axis=1) - 1).mean() for each in world]
            assert off[1] < 0.7 * off[0]
            assert again.frames.noise < prepared.frames.noise == again.noise
            assert not needs_denoising(again)
            assert upsampler(cloud, 4).report["noise"] == prepared.noise


def test_detail_is_not_noise(upsampler):
    """Detail with large residuals that hardly moves under projection is not denoised."""
    u, v = np.random.default_rng(0).random((2, 1500)) * 30
    folds = np.column_stack([u, v, 0.8 * np.abs((u + 0.3 * v) % 4 - 2)])
    (tile,) = make_plan(Cloud(folds), Options(4.0)).tiles
    prepared = prepare(tile)
    assert needs_denoising(prepared)
    assert denoise(upsampler.model, prepared, predict(upsampler, prepared)) is None


class RecordedStages:
    """Stages that only record their names; the first prepared value is noisy."""

    def __init__(self, moves: bool) -> None:
        self.moves = moves
        self.calls: list[str] = []

    async def prepare(self, tile):
        self.calls.append("prepare")
        return tile

    async def predict(self, prepared):
        self.calls.append("predict")
        return prepared

    def needs_denoising(self, prepared):
        return prepared == "noisy"

    async def denoise(self, _prepared, _charts):
        self.calls.append("denoise")
        return "moved" if self.moves else None

    async def densify(self, prepared, charts):
        self.calls.append("densify")
        return prepared, charts


@pytest.mark.parametrize(
    ("tile", "moves", "calls", "result"),
    [
        ("clean", True, "prepare predict densify", "clean"),
        ("noisy", True, "prepare predict denoise prepare predict densify", "moved"),
        ("noisy", False, "prepare predict denoise densify", "noisy"),
    ],
)
def test_the_stages_of_a_tile(tile, moves, calls, result):
    """A noisy tile is prepared and predicted again, if denoising moved its points."""
    stages = RecordedStages(moves)
    assert run_here(upsample_tile(stages, tile)) == (result, result)
    assert stages.calls == calls.split()


def test_a_local_stage_must_not_wait():
    """A coroutine that waits for an event loop is an error and not a silent stop."""

    class Waiting:
        def __await__(self) -> Generator[None]:
            yield

    async def wait():
        await Waiting()

    with pytest.raises(RuntimeError, match="event loop"):
        run_here(wait())
