# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing


def test_areas_follow_the_density():
    """Areas are a quarter at four times the density, and smooth."""
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((4000, 3)), rng.random((1000, 3)) + [1, 0, 0]
    points = np.concatenate([dense, sparse]) * [1, 1, 0]
    distances, neighbours = nearest(points)
    area = surface_areas(spacing(distances), neighbours)
    assert area[points[:, 0] > 1.5].mean() / area[points[:, 0] < 0.5].mean() == pytest.approx(
        4, rel=0.1
    )
    assert area[points[:, 0] < 0.5].std() < 0.1 * area[points[:, 0] < 0.5].mean()


def test_small_differences_are_ignored():
    """All points of an even input have the same area; large differences are kept."""
    grid = np.stack(np.meshgrid(np.arange(60.0), np.arange(60.0)), axis=-1).reshape(-1, 2)
    points = np.append(grid, np.zeros((3600, 1)), axis=1)
    distances, neighbours = nearest(points)
    left = points[:, 0] < 30
    inside = np.abs(points[:, :2] - 29.5).max(axis=1) < 15
    nearly = spacing(distances) * np.where(left, 1.0, 1.02).astype(np.float32)
    assert np.ptp(surface_areas(nearly, neighbours)[inside]) < 1e-12
    differing = spacing(distances) * np.where(left, 1.0, 1.5).astype(np.float32)
    middle = np.abs(points[:, 1] - 29.5) < 5
    for typical in (None, 1.0, 7.0):
        area = surface_areas(differing, neighbours, typical)
        low, high = (area[middle & (points[:, 0] == x)] for x in (10, 50))
        assert high / low == pytest.approx(1.5**2, rel=0.05)


def test_a_given_typical_spacing():
    """In a part of a larger cloud with another typical spacing, small differences are kept."""
    grid = np.stack(np.meshgrid(np.arange(60.0), np.arange(60.0)), axis=-1).reshape(-1, 2)
    points = np.append(grid, np.zeros((3600, 1)), axis=1)
    distances, neighbours = nearest(points)
    here = spacing(distances) * np.where(points[:, 0] < 30, 1.0, 1.02).astype(np.float32)
    usual = float(np.median(here))
    middle = np.abs(points[:, 1] - 29.5) < 5
    for typical, ratio in ((usual, 1.0), (3.0 * usual, 1.02**2)):
        area = surface_areas(here, neighbours, typical)
        low, high = (area[middle & (points[:, 0] == x)].mean() for x in (10, 50))
        assert high / low == pytest.approx(ratio, abs=0.004)
