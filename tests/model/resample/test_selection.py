# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.metrics.clouds import evenness
from pugeo_model.resample.elimination import chart_radii
from pugeo_model.resample.selection import select, spread_evenly
from pugeo_model.tuning import TUNING


@pytest.fixture(scope="module")
def plane():
    """Charts of an even unit square with six candidates each, neighbours and areas."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(45), np.arange(45)), axis=-1).reshape(-1, 2)
    points = np.append((grid + 0.5 * rng.random(grid.shape)) / 45, np.zeros((2025, 1)), axis=1)
    distances, neighbours = nearest(points)
    offsets = rng.uniform(-0.7 / 45, 0.7 / 45, size=(2025, 6, 3)) * [1, 1, 0]
    candidates = (points[:, None] + offsets).reshape(-1, 3)
    owner = np.repeat(np.arange(2025, dtype=np.int32), 6)
    area = surface_areas(spacing(distances), neighbours)
    return points, neighbours, area, candidates, owner


def radii(area, wanted):
    """Packing radii if all charts belong to the core."""
    return chart_radii(area, None, np.ones(len(area), np.bool_), wanted)


def up(count):
    """Vertical normals."""
    return np.tile(np.array([0, 0, 1], dtype=np.float32), (count, 1))


def test_penalties_do_not_change_the_density(plane):
    """Other candidates are selected in place of those with large errors."""
    points, neighbours, area, candidates, owner = plane
    inaccurate = (points[owner, 0] < 0.5) & (np.arange(len(owner)) % 5 == 0)
    error = np.where(inaccurate, 0.2, 0.02).astype(np.float32)
    kept_inputs, selected, kept = select(
        candidates, up(len(candidates)), error, owner, 7000, radii(area, 7000), neighbours, seed=0
    )
    assert len(kept_inputs) == 0
    assert len(selected) == len(kept) == 7000
    expected = (points[:, 0] < 0.5).mean()
    assert (points[kept, 0] < 0.5).mean() == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("keep_all", [False, True])
def test_pinned_points(plane, keep_all):
    """Points of the input may be selected, or all have to be; they keep their positions."""
    points, neighbours, area, candidates, owner = plane
    error = np.full(len(owner), 0.02, dtype=np.float32)
    kept_inputs, selected, _ = select(
        candidates,
        up(len(owner)),
        error,
        owner,
        7000,
        radii(area, 7000),
        neighbours,
        seed=0,
        pinned=(points, up(len(points)), np.arange(len(points), dtype=np.int32)),
        keep_all=keep_all,
    )
    assert len(kept_inputs) + len(selected) == 7000
    assert (np.diff(kept_inputs) > 0).all()
    assert (len(kept_inputs) == len(points)) is keep_all
    assert len(kept_inputs) > 100
    assert evenness(np.concatenate([points[kept_inputs], selected])) < 0.2


def test_projected_points_become_even_again(plane):
    """One round of repulsion makes disturbed points even; points next to a margin do not move."""
    points, neighbours, area, candidates, owner = plane
    error = np.full(len(owner), 0.02, dtype=np.float32)
    core = points[:, 0] < 0.7
    radius = chart_radii(area, None, core, 5600)
    _, selected, kept = select(
        candidates, up(len(owner)), error, owner, 5600, radius, neighbours, seed=0, core=core
    )
    noise = np.random.default_rng(0).normal(size=selected.shape, scale=0.001)
    moved = selected + noise * [1, 1, 0]
    after = spread_evenly(moved, up(5600), kept, radius, neighbours, core)
    assert evenness(after) < 0.9 * evenness(moved)
    unchanged = (after == moved).all(axis=1)
    assert unchanged[moved[:, 0] > 0.69].mean() > 0.9
    assert unchanged[moved[:, 0] < 0.5].mean() < 0.01


def test_a_lower_limit_of_the_usual_error_thins_unsure_places(plane):
    """Fewer points stand where errors are three times those around; their number is exact."""
    points, neighbours, area, candidates, owner = plane
    unsure = np.abs(points[:, 0] - 0.5) < 0.03
    error = np.where(unsure[owner], 0.06, 0.02).astype(np.float32)
    shares = []
    for limit in (TUNING.usual_error_most, TUNING.usual_error_scan):
        _, selected, kept = select(
            candidates,
            up(len(owner)),
            error,
            owner,
            7000,
            radii(area, 7000),
            neighbours,
            seed=0,
            most_error=limit,
        )
        assert len(selected) == 7000
        shares.append(unsure[kept].mean())
    assert shares[1] < 0.9 * shares[0]
