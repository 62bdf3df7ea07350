# SPDX-License-Identifier: Apache-2.0
"""Options on scans whose charts represent several points: kept points, gaps, tiles, spacings."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.assembly import Result
from pugeo_model.cloud import Cloud
from pugeo_model.errors import BadOptionError
from pugeo_model.geometry.neighbours import knn
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.upsampler import Upsampler

NOISE = 0.05
TILE = 250  # charts of a tile, so that there are several


@pytest.fixture(scope="module")
def upsampler() -> Upsampler:
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


@pytest.fixture(scope="module")
def scan() -> Cloud:
    """A ball of 4,000 points, far from the origin, ten times denser on one side; attributes."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(22_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    share = np.where(points[:, 0] > 0, 1.0, 0.1)
    points = points[rng.permutation(len(points))[rng.random(len(points)) < share]][:4000]
    points += rng.normal(0.0, NOISE, points.shape)
    return Cloud(
        points + [1000.0, 0.0, 0.0],
        colors=rng.integers(0, 256, points.shape, dtype=np.uint8),
        scalars={"depth": rng.random(len(points)).astype(np.float32)},
    )


def radius_error(points: NDArray[np.floating]) -> float:
    """Root mean square distance from the ball's surface."""
    radius = np.linalg.norm(points - [1000.0, 0.0, 0.0], axis=1)
    return float(np.sqrt(np.mean((radius - 1.0) ** 2)))


def run(upsampler: Upsampler, cloud: Cloud, options: Options, tile: int | None = TILE) -> Result:
    """Upsample in tiles of so many charts."""
    plan = make_plan(cloud, options, tile)
    assert plan.input is not None
    assert len(plan.points) < 0.7 * len(cloud)
    assert tile is None or len(plan.tile_specs) > 2
    return upsampler.upsample(plan)


@pytest.mark.parametrize("tile", [TILE, None])
@pytest.mark.parametrize("density", ["input", "even"])
def test_denoised_points_keep_order_and_attributes(
    upsampler: Upsampler, scan: Cloud, density: str, tile: int | None
) -> None:
    """Each point moves onto the surface, by about its noise, and keeps what it carries."""
    options = Options(ratio=1.0, denoise=True, density=density)
    dense = run(upsampler, scan, options, tile).cloud
    assert len(dense) == len(scan)
    assert np.linalg.norm(dense.points - scan.points, axis=1).max() < 8 * NOISE
    assert radius_error(dense.points) < 0.35 * NOISE
    np.testing.assert_array_equal(dense.colors, scan.colors)
    np.testing.assert_array_equal(dense.scalars["depth"], scan.scalars["depth"])


@pytest.mark.parametrize(
    "options",
    [
        Options(ratio=1.0, density="even"),
        Options(ratio=1.3, density="even", keep_input=True),
        Options(ratio=2.0, keep_input=True),
    ],
    ids=["ratio 1", "even", "input"],
)
@pytest.mark.parametrize("tile", [TILE, None])
def test_kept_points_lead(
    upsampler: Upsampler, scan: Cloud, options: Options, tile: int | None
) -> None:
    """All input points lead in order, though an even density gives dense tiles fewer points."""
    dense = run(upsampler, scan, options, tile).cloud
    assert len(dense) == round(options.ratio * len(scan))
    np.testing.assert_array_equal(dense.points[: len(scan)], scan.points)
    assert dense.colors is not None
    np.testing.assert_array_equal(dense.colors[: len(scan)], scan.colors)
    np.testing.assert_array_equal(dense.scalars["depth"][: len(scan)], scan.scalars["depth"])


def test_no_gap_is_larger_than_asked(upsampler: Upsampler, scan: Cloud) -> None:
    """A point of the answer is as near to a point of the scan as asked, in the scan's units."""
    wide = knn(cKDTree(scan.points), run(upsampler, scan, Options(ratio=2.0)).cloud.points, 1)[0]
    gap = float(np.quantile(wide, 0.8))
    dense = run(upsampler, scan, Options(ratio=2.0, max_gap=gap)).cloud
    assert len(dense) == 2 * len(scan)
    assert knn(cKDTree(scan.points), dense.points, 1)[0].max() < gap * (1 + 1e-6)


@pytest.mark.parametrize("tile", [TILE, None])
def test_no_point_is_moved_farther_than_asked(
    upsampler: Upsampler, scan: Cloud, tile: int | None
) -> None:
    """Denoised points stay as near to their own places as asked, in every tile."""
    moved = run(upsampler, scan, Options(ratio=1.0, denoise=True, max_gap=0.03), tile).cloud
    distance = np.linalg.norm(moved.points - scan.points, axis=1)
    assert distance.max() < 0.03 * (1 + 1e-6)
    assert np.count_nonzero(distance > 0.02) > 0.1 * len(scan)


def test_a_spacing_is_reached(upsampler: Upsampler, scan: Cloud) -> None:
    """The spacing that was asked for is that of the answer, on the dense and the sparse side."""
    dense = run(upsampler, scan, Options(spacing=0.08)).cloud
    distance = knn(cKDTree(dense.points), dense.points, 2)[0][:, 1]
    right = dense.points[:, 0] > 1000.0
    for side in (right, ~right):
        assert 0.064 < np.median(distance[side]) < 0.088


def test_a_spacing_out_of_range(scan: Cloud) -> None:
    """A spacing for more than 32 times the points, or for fewer than 8, names the range."""
    for spacing in (1e-4, 50.0):
        with pytest.raises(
            BadOptionError, match=r"spacing must be from [\d.]+ to [\d.]+"
        ) as caught:
            make_plan(scan, Options(spacing=spacing))
        finest, coarsest = caught.value.fields["limit"]
        assert 0.001 < finest < 0.01
        assert 0.5 < coarsest < 5.0
