# SPDX-License-Identifier: Apache-2.0
"""Charts of redundant scans: noise, lattices, scan lines, stacked frames, wires, stray points."""

import numpy as np
import pytest

from pugeo_model.geometry.centres import Centres, choose_centres
from pugeo_model.geometry.neighbours import nearest
from pugeo_model.geometry.scale import LocalScale, measure_scale
from pugeo_model.input_points import represent


def _ball(count: int, noise: float) -> np.ndarray:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points + rng.normal(size=points.shape) * noise


def _lattice(noise: float, frames: int = 1) -> np.ndarray:
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), -1).reshape(-1, 2)
    return np.concatenate([np.c_[grid, rng.normal(size=len(grid)) * noise] for _ in range(frames)])


def _scan_lines() -> np.ndarray:
    x, y = np.meshgrid(np.arange(300.0), np.arange(12) * 15.0)
    rng = np.random.default_rng(7)
    return np.stack([x + rng.uniform(-0.3, 0.3, x.shape), y, 0.0 * x], -1).reshape(-1, 3)


def _unit(points: np.ndarray) -> tuple[np.ndarray, float]:
    size = float(np.ptp(points, axis=0).max())
    return points / size, size


def _measured(points: np.ndarray) -> tuple[LocalScale, Centres, float]:
    """Scale and centres in the units of the points, and the longest side."""
    unit, size = _unit(points)
    distances, neighbours = nearest(unit)
    scale = measure_scale(unit, neighbours, distances)
    centres = choose_centres(unit, scale, np.zeros(len(points), np.bool_))
    return (
        scale,
        Centres(centres.points * size, centres.of_point, centres.count, centres.on_curve),
        size,
    )


@pytest.mark.parametrize("points", [_ball(5000, 0.0), _lattice(0.0)], ids=["ball", "lattice"])
def test_clean_points_have_their_own_charts(points: np.ndarray) -> None:
    """Clean points represent themselves, at every point and by the quick test of a sample."""
    scale, _, _ = _measured(points)
    assert not scale.coarse.any()
    assert represent(_unit(points)[0], keep_all=False) is None


@pytest.mark.parametrize(
    "points",
    [_ball(20_000, 0.02), _lattice(0.3), _lattice(0.3, frames=10), _scan_lines()],
    ids=["noise", "lattice", "frames", "lines"],
)
def test_redundant_points_are_represented_by_fewer_charts(points: np.ndarray) -> None:
    """The quick test lets none of the redundant kinds pass, and every point has a chart."""
    found = represent(_unit(points)[0], keep_all=True)
    assert found is not None
    assert len(found.centres.points) < 0.7 * len(points)
    assert np.array_equal(np.sort(found.order), np.arange(len(points)))


@pytest.mark.slow
def test_more_points_of_the_same_noise_give_better_centres() -> None:
    """The error of the centres of a noisy ball falls as its points become more."""
    errors = []
    for count in (20_000, 40_000, 80_000):
        _, centres, _ = _measured(_ball(count, 0.02))
        errors.append(float(np.std(np.linalg.norm(centres.points, axis=1))))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] < 0.5 * 0.02
    assert errors[-1] < 0.35 * 0.02


def test_centres_of_a_noisy_ball_do_not_shrink_it() -> None:
    """Centres lie on a curved surface, no plain mean: their mean radius is that of the ball."""
    _, centres, _ = _measured(_ball(20_000, 0.02))
    assert abs(np.linalg.norm(centres.points, axis=1).mean() - 1.0) < 0.002


@pytest.mark.parametrize("noise", [0.1, 0.16, 0.3])
def test_noise_on_a_flat_lattice_is_averaged(noise: float) -> None:
    """Centres of a lattice with noise along the view are nearer to its plane than its points."""
    scale, centres, _ = _measured(_lattice(noise))
    assert scale.coarse.mean() > 0.95
    assert centres.points[:, 2].std() < 0.5 * noise


def test_stacked_frames_are_one_surface() -> None:
    """Thirty points on every ray become few centres near the plane."""
    scale, centres, _ = _measured(_lattice(0.3, frames=30))
    assert scale.coarse.mean() > 0.9
    assert len(centres.points) < 3 * 1600
    assert centres.points[:, 2].std() < 0.7 * 0.3


@pytest.mark.parametrize("frames", [3, 5, 10])
def test_few_stacked_frames_are_averaged(frames: int) -> None:
    """Also a few frames, whose points do not look noisy by a fit to the nearest."""
    _, centres, _ = _measured(_lattice(0.3, frames=frames))
    assert centres.points[:, 2].std() < 0.6 * 0.3


def test_scan_lines_have_a_scale_across_lines() -> None:
    """Lines fifteen times further apart than their points have a scale that spans several."""
    scale, _, size = _measured(_scan_lines())
    assert scale.coarse.mean() > 0.9
    assert np.median(scale.spacing) * size > 6.0


def test_a_wire_keeps_its_points() -> None:
    """Points along a helix are on no surface: they are counted and stay where they are."""
    turn = np.linspace(0.0, 6.0 * np.pi, 2000)
    points = np.stack([np.cos(turn), np.sin(turn), 0.3 * turn], axis=1)
    scale, centres, _ = _measured(points)
    assert scale.curve.mean() > 0.9
    assert not scale.coarse[scale.curve].any()
    assert len(centres.points) > 0.9 * len(points)


def test_both_sides_of_a_noisy_wall_stay_apart() -> None:
    """Centres of a wall five standard deviations thick, beside a plate, lie on its sides."""
    rng = np.random.default_rng(2)
    side = rng.uniform(0.0, 1.0, (24_000, 2)) * [3.0, 1.0]
    double = (side[:, 0] < 0.3) & (np.arange(24_000) % 2 == 0)
    height = np.where(double, 0.1, 0.0) + rng.normal(size=24_000) * 0.02
    _, centres, _ = _measured(np.c_[side, height])
    wall = centres.points[centres.points[:, 0] < 0.25]
    middle = np.abs(wall[:, 2] - 0.05) < 0.02
    assert middle.mean() < 0.08


def test_points_that_fill_a_volume_are_no_surface() -> None:
    """Many points of a solid ball are no thin sheet at any scale: charts stay fine."""
    points = np.random.default_rng(0).normal(size=(60_000, 3))
    scale, centres, _ = _measured(points)
    assert len(centres.points) > 0.2 * len(points)
    assert np.median(scale.spacing) < 0.05


def test_stray_points_have_no_chart() -> None:
    """Isolated points far off a ball are left out, and none of the ball is."""
    rng = np.random.default_rng(3)
    away = rng.normal(size=(60, 3))
    away *= rng.uniform(1.3, 1.8, (60, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    unit, _ = _unit(np.concatenate([_ball(5000, 0.0), away]))
    found = represent(unit, keep_all=False)
    assert found is not None
    assert found.stray[5000:].sum() >= 54
    assert not found.stray[:5000].any()
    assert len(found.centres.points) == 5060 - found.stray.sum()
    everything = represent(unit, keep_all=True)
    assert everything is None or not everything.stray.any()


def test_the_order_of_points_does_not_matter() -> None:
    """Centres of the same points in another order are the same places."""
    points = _ball(4000, 0.03)
    _, first, _ = _measured(points)
    _, second, _ = _measured(points[np.random.default_rng(1).permutation(len(points))])
    assert len(first.points) == len(second.points)
    distance = np.linalg.norm(
        first.points[np.lexsort(first.points.T)] - second.points[np.lexsort(second.points.T)],
        axis=1,
    )
    assert np.median(distance) < 1e-9
