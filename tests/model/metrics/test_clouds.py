# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.metrics.clouds import (
    chamfer,
    evenness,
    hausdorff,
    jensen_shannon,
    nearest_both,
    sphere_distances,
)


@pytest.fixture
def grid():
    """A regular grid of spacing 0.1 in the plane z = 0."""
    flat = np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2) / 10 - 0.45
    return np.concatenate([flat, np.zeros((100, 1))], axis=1)


def test_lifted_grid_is_as_far_as_it_is_lifted(grid):
    """A copy lifted by 0.01 has CD = HD = 0.01 exactly."""
    there, back = nearest_both(grid, grid + [0, 0, 0.01])
    assert chamfer(there, back) == pytest.approx(0.01)
    assert hausdorff(there, back) == pytest.approx(0.01)


def test_one_outlier_is_the_hausdorff_distance(grid):
    """HD is the one worst distance, whichever side it is on."""
    off = grid.copy()
    off[0, 2] = 0.3
    assert hausdorff(*nearest_both(off, grid)) == pytest.approx(0.3)
    assert hausdorff(*nearest_both(grid, off)) == pytest.approx(0.3)


def test_jensen_shannon_bounds(grid):
    """Equal clouds have 0, clouds that share no cell have 1 bit."""
    assert jensen_shannon(grid, grid) == 0.0
    assert jensen_shannon(grid, grid + [0, 0, 0.3]) == pytest.approx(1.0)


def test_sphere_distances_ignore_place_and_scale(grid):
    """SCD and sHD of a moved and scaled copy are 0; both are squared, summed over both sides."""
    assert sphere_distances(grid, 3 * grid + 1) == pytest.approx((0.0, 0.0), abs=1e-20)
    ring = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
    turned = np.array([[1, 1, 0], [-1, -1, 0], [-1, 1, 0], [1, -1, 0]]) / np.sqrt(2)
    apart = 2 - np.sqrt(2)
    assert sphere_distances(ring, turned) == pytest.approx((2 * apart, 2 * apart))


def test_evenness_of_a_grid_is_zero(grid):
    """All nearest distances equal: no variation."""
    assert evenness(grid) == pytest.approx(0.0, abs=1e-12)
