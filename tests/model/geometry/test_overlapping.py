# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.overlapping import (
    OVERLAP,
    PATCH_POINTS,
    normalise_patch,
    overlapping_patches,
    patch_count,
)


def test_patches_overlap_and_cover(sphere):
    """Every point lies in one patch at least, and in about three on average."""
    patches = overlapping_patches(sphere)
    assert len(patches) >= patch_count(len(sphere)) == -(-OVERLAP * 2000 // 256)
    times = np.bincount(np.concatenate([p.rows for p in patches]), minlength=len(sphere))
    assert times.min() >= 1
    assert OVERLAP <= times.mean() <= OVERLAP + 1


def test_a_patch_is_the_nearest_points_of_its_seed(sphere):
    """The 256 nearest to the first of its rows, centred and of radius 1."""
    tree = cKDTree(sphere)
    for patch in overlapping_patches(sphere):
        wanted = np.asarray(tree.query(sphere[patch.rows[0]], PATCH_POINTS)[1])
        assert set(patch.rows) == set(wanted)
        back = patch.centre + patch.radius * patch.points
        np.testing.assert_allclose(back, sphere[patch.rows], atol=1e-6)
        assert np.linalg.norm(patch.points, axis=1).max() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("count", [3, 12, 255, 256])
def test_small_clouds_are_one_patch(sphere, count):
    """Filled up to 256 points by repetition, so that the graphs have their neighbours."""
    (patch,) = overlapping_patches(sphere[:count])
    assert len(patch.rows) == PATCH_POINTS
    assert set(patch.rows) == set(range(count))
    assert patch_count(count) == 1


def test_a_far_island_is_covered():
    """Points in none of the seeds' patches become seeds too."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((3000, 3)), 1e-3 * rng.random((1000, 3)) + 5.0])
    rows = np.concatenate([p.rows for p in overlapping_patches(points)])
    assert set(rows) == set(range(4000))


def test_one_spot_has_a_radius():
    """Points that coincide are centred and not divided by zero."""
    local, centre, radius = normalise_patch(np.ones((5, 3)))
    assert (local == 0).all()
    assert (centre == 1).all()
    assert radius == 1.0
