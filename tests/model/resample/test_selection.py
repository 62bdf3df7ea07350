# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.metrics.clouds import evenness
from pugeo_model.resample.selection import select, spread_evenly


@pytest.fixture(scope="module")
def plane():
    """Charts roughly evenly in a unit square, six candidates each, and what both need."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(45), np.arange(45)), axis=-1).reshape(-1, 2)
    points = np.append((grid + 0.5 * rng.random(grid.shape)) / 45, np.zeros((2025, 1)), axis=1)
    distances, neighbours = nearest(points)
    spread = rng.uniform(-0.7 / 45, 0.7 / 45, size=(2025, 6, 3)) * [1, 1, 0]
    candidates = (points[:, None] + spread).reshape(-1, 3)
    owner = np.repeat(np.arange(2025, dtype=np.int32), 6)
    return points, neighbours, surface_areas(spacing(distances), neighbours), candidates, owner


def up(count):
    return np.tile(np.array([0, 0, 1], dtype=np.float32), (count, 1))


def test_doubt_costs_a_region_no_points(plane):
    """Where many candidates expect much error others stay in their select: the input's density."""
    points, neighbours, area, candidates, owner = plane
    doubted = (points[owner, 0] < 0.5) & (np.arange(len(owner)) % 5 == 0)
    error = np.where(doubted, 0.2, 0.02).astype(np.float32)
    stay, queries, kept = select(
        candidates, up(len(candidates)), error, owner, 7000, area, neighbours, seed=0
    )
    assert len(stay) == 0
    assert len(queries) == len(kept) == 7000
    wanted = (points[:, 0] < 0.5).mean()
    assert (points[kept, 0] < 0.5).mean() == pytest.approx(wanted, abs=0.012)


def test_landed_points_are_evened_out(plane):
    """What landing moved settles again; points next to a margin and in its select stay."""
    points, neighbours, area, candidates, owner = plane
    error = np.full(len(owner), 0.02, dtype=np.float32)
    core = points[:, 0] < 0.7
    _, queries, kept = select(
        candidates, up(len(owner)), error, owner, 5600, area, neighbours, seed=0, core=core
    )
    moved = queries + np.random.default_rng(0).normal(size=queries.shape, scale=0.001) * [1, 1, 0]
    after = spread_evenly(moved, up(5600), kept, area, neighbours, core)
    assert evenness(after) < 0.9 * evenness(moved)
    stayed = (after == moved).all(axis=1)
    assert stayed[moved[:, 0] > 0.69].mean() > 0.9
    assert stayed[moved[:, 0] < 0.5].mean() < 0.01
