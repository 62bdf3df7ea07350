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


def test_a_shifted_grid(grid):
    """A copy shifted by 0.01 along its normal has CD = HD = 0.01."""
    there, back = nearest_both(grid, grid + [0, 0, 0.01])
    assert chamfer(there, back) == pytest.approx(0.01)
    assert hausdorff(there, back) == pytest.approx(0.01)


def test_one_outlier_is_the_hausdorff_distance(grid):
    """HD is the largest distance of both directions."""
    off = grid.copy()
    off[0, 2] = 0.3
    assert hausdorff(*nearest_both(off, grid)) == pytest.approx(0.3)
    assert hausdorff(*nearest_both(grid, off)) == pytest.approx(0.3)


def test_jensen_shannon_bounds(grid):
    """Equal clouds have 0, clouds that share no cell have 1 bit."""
    assert jensen_shannon(grid, grid) == 0.0
    assert jensen_shannon(grid, grid + [0, 0, 0.3]) == pytest.approx(1.0)


def test_sphere_distances_ignore_place_and_scale(grid):
    """The distances of a moved and scaled copy are 0; others are sums of squares of both sides."""
    assert sphere_distances(grid, 3 * grid + 1) == pytest.approx((0.0, 0.0), abs=1e-20)
    ring = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
    turned = np.array([[1, 1, 0], [-1, -1, 0], [-1, 1, 0], [1, -1, 0]]) / np.sqrt(2)
    apart = 2 - np.sqrt(2)
    assert sphere_distances(ring, turned) == pytest.approx((2 * apart, 2 * apart))


def test_evenness_of_a_grid_is_zero(grid):
    """Equal nearest distances have no variation."""
    assert evenness(grid) == pytest.approx(0.0, abs=1e-12)
