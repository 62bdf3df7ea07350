# SPDX-License-Identifier: Apache-2.0
"""Fits of curves against their closed form, and points that are moved onto them."""

import numpy as np
import pytest

from pugeo_model.geometry.curve_fit import CURVE, KURTOSIS, RADIUS, curve_point, fit_curve
from pugeo_model.geometry.curves import centres_on_curves, onto_curves
from pugeo_model.geometry.neighbours import nearest, spacing


def _fit(points: np.ndarray) -> np.ndarray:
    out = np.zeros(CURVE)
    fit_curve(np.ascontiguousarray(points.T), np.empty(len(points)), np.zeros((6, 3)), out)
    return out


def _turn() -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def test_a_parabola_is_recovered() -> None:
    """Points of a curve of degree two lie on its fit, in any frame, and so do points between."""
    s = np.linspace(-0.8, 0.8, 101)
    curve = np.c_[s, 0.05 * s**2 - 0.02, 0.1 + 0 * s] @ _turn().T
    out = _fit(curve[::5])
    assert out[RADIUS] < 1e-4
    found = [curve_point(out, *place, -1.0, 1.0) for place in curve]
    assert np.abs(np.array(found) - curve).max() < 2e-4


def test_the_parameter_is_bounded() -> None:
    """A place beyond the end of a line is moved to its end."""
    line = np.c_[np.linspace(-0.5, 0.5, 21), np.zeros((21, 2))]
    found = curve_point(_fit(line), 3.0, 0.2, 0.1, -0.5, 0.5)
    assert np.allclose(np.abs(found), [0.5, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(("pole", "kurtosis"), [(True, 1.0), (False, 2.0)])
def test_noise_and_the_surface_of_a_pole_differ(pole: bool, kurtosis: float) -> None:
    """Of noise around a line the kurtosis is 2, of the points on a cylinder it is 1."""
    rng = np.random.default_rng(0)
    across = rng.normal(size=(4000, 2))
    if pole:
        across /= np.linalg.norm(across, axis=1, keepdims=True)
    out = _fit(np.c_[rng.uniform(-0.9, 0.9, 4000), 0.05 * across])
    assert out[KURTOSIS] == pytest.approx(kurtosis, abs=0.15)
    assert out[RADIUS] == pytest.approx(0.05 / np.sqrt(2.0) if pole else 0.05, rel=0.05)


def _row_of_charts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    turn = np.linspace(0.0, 2.0, 60)
    charts = np.c_[np.cos(turn), np.sin(turn), 0.2 * turn]
    distances, neighbours = nearest(charts)
    return charts, neighbours, spacing(distances)


def test_points_are_moved_onto_the_curve_of_their_charts() -> None:
    """Points beside a helix are moved onto it, those beside other charts stay."""
    charts, neighbours, apart = _row_of_charts()
    rng = np.random.default_rng(1)
    owner = rng.integers(0, 60, 500).astype(np.int32)
    points = charts[owner] + rng.normal(size=(500, 3)) * 0.3 * apart[owner, None]
    fine = np.linspace(-0.1, 2.1, 20_001)
    helix = np.c_[np.cos(fine), np.sin(fine), 0.2 * fine]
    on_curve = np.ones(60, np.bool_)
    on_curve[20:40] = False
    moved = onto_curves(points, owner, charts, neighbours, on_curve, apart)
    beside = ~on_curve[owner]
    assert (moved[beside] == points[beside]).all()
    away = np.array([np.linalg.norm(helix - point, axis=1).min() for point in moved[~beside]])
    assert away.max() < 0.02 * np.median(apart)


def test_points_stay_within_the_ends_of_a_curve() -> None:
    """A point is moved at most half a step beyond the last chart."""
    charts = np.c_[np.arange(12.0), np.zeros((12, 2))]
    neighbours = nearest(charts)[1]
    points = np.array([[12.9, 0.3, 0.0], [-2.0, 0.0, 0.1]])
    owner = np.array([11, 0], np.int32)
    moved = onto_curves(
        points, owner, charts, neighbours, np.ones(12, np.bool_), np.full(12, 2.0, np.float32)
    )
    assert np.allclose(moved, [[11.5, 0.0, 0.0], [-0.5, 0.0, 0.0]], atol=1e-6)


def test_where_curves_cross_points_stay() -> None:
    """Four wires that meet have no single curve through their charts."""
    arms = np.arange(1.0, 6.0)
    flat = np.r_[
        np.c_[arms, 0 * arms], np.c_[-arms, 0 * arms], np.c_[0 * arms, arms], np.c_[0 * arms, -arms]
    ]
    charts = np.r_[[[0.0, 0.0, 0.0]], np.c_[flat, np.zeros(20)]]
    distances, neighbours = nearest(charts, 10)
    points = np.array([[0.2, 0.3, 0.1]])
    moved = onto_curves(
        points,
        np.zeros(1, np.int32),
        charts,
        neighbours,
        np.ones(21, np.bool_),
        spacing(distances),
    )
    assert (moved == points).all()


def test_centres_lie_on_the_curve_through_the_noise() -> None:
    """Places off a noisy line are moved onto it: most of the noise is averaged."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(0.0, 10.0, 5000), rng.normal(size=(5000, 2)) * 0.1]
    places = np.c_[np.linspace(1.0, 9.0, 20), rng.normal(size=(20, 2)) * 0.1]
    moved = centres_on_curves(points, places, np.full(20, 0.4))
    assert np.linalg.norm(moved[:, 1:], axis=1).max() < 0.04
    assert np.abs(moved[:, 0] - places[:, 0]).max() < 0.05
