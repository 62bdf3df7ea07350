# SPDX-License-Identifier: Apache-2.0
"""Wires and single lines: points stay on the curve, and the report says how many."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.upsampler import Upsampler

_FINE = np.linspace(0.0, 1.0, 50_001)
_CURVES = {
    "helix": np.c_[0.3 * np.cos(9.0 * _FINE), 0.3 * np.sin(9.0 * _FINE), _FINE],
    "catenary": np.c_[_FINE, 0.0 * _FINE, 0.3 * np.cosh(2.0 * _FINE - 1.0)],
    "line": np.c_[_FINE, 0.5 * _FINE, -0.2 * _FINE],
}


def _wire(name: str, count: int, noise: float) -> tuple[np.ndarray, cKDTree, float]:
    """Points of a wire, the wire, and the spacing along it; the noise is in spacings."""
    curve = _CURVES[name]
    step = float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()) / count
    rng = np.random.default_rng(4)
    points = curve[np.sort(rng.choice(len(curve), count, replace=False))]
    return points + rng.normal(size=points.shape) * noise * step, cKDTree(curve), step


def _error(points: np.ndarray, wire: cKDTree) -> float:
    """Root mean square distance from the wire."""
    return float(np.sqrt(np.mean(wire.query(points)[0] ** 2)))


@pytest.fixture(scope="module")
def upsampler() -> Upsampler:
    """The released network."""
    return Upsampler()


@pytest.mark.parametrize("name", ["helix", "catenary"])
def test_answers_stay_on_a_wire(upsampler: Upsampler, name: str) -> None:
    """Between the points of a wire new ones lie on it, not beside it."""
    points, wire, step = _wire(name, 1500, 0.0)
    result = upsampler(Cloud(points), 4.0)
    assert len(result.cloud.points) == 6000
    assert _error(result.cloud.points, wire) < 0.1 * step
    assert result.report["on_curves"] > 0.95 * 1500


@pytest.mark.parametrize("name", ["helix", "catenary", "line"])
@pytest.mark.parametrize(
    ("count", "noise", "left"), [(1500, 0.3, 0.75), (1500, 3.0, 0.7), (12_000, 20.0, 0.45)]
)
def test_noise_around_a_wire_is_averaged(
    upsampler: Upsampler, name: str, count: int, noise: float, left: float
) -> None:
    """More points of the same noise give a better answer, also where they fill a tube."""
    points, wire, _ = _wire(name, count, noise)
    result = upsampler(Cloud(points), 2.0)
    assert _error(result.cloud.points, wire) < left * _error(points, wire)
    assert result.report["on_curves"] > 0.8 * count


def test_the_points_of_a_noisy_wire_can_be_moved_onto_it(upsampler: Upsampler) -> None:
    """``denoise`` with R = 1 gives back the input's points, in order, near the wire."""
    points, wire, _ = _wire("catenary", 3000, 6.0)
    moved = upsampler(Cloud(points), 1.0, denoise=True).cloud.points
    assert len(moved) == 3000
    assert _error(moved, wire) < 0.5 * _error(points, wire)
    assert np.abs(moved[:, 0] - points[:, 0]).max() < 0.1


def test_the_input_stays_where_it_is_kept(upsampler: Upsampler) -> None:
    """Kept points of a wire are not moved, new ones lie on it."""
    points, wire, step = _wire("helix", 1000, 0.0)
    dense = upsampler(Cloud(points), 3.0, keep_input=True).cloud.points
    assert np.allclose(dense[: len(points)], points, atol=1e-9)
    assert _error(dense, wire) < 0.15 * step


def test_a_pole_stays_a_surface(upsampler: Upsampler) -> None:
    """Points on a thin cylinder are a surface: none is moved to its axis."""
    rng = np.random.default_rng(0)
    turn = rng.uniform(0.0, 2.0 * np.pi, 4000)
    points = np.c_[0.02 * np.cos(turn), 0.02 * np.sin(turn), rng.uniform(0.0, 1.0, 4000)]
    for noise in (0.0, 0.002):
        noisy = points + rng.normal(size=points.shape) * noise
        result = upsampler(Cloud(noisy), 2.0)
        radius = np.linalg.norm(result.cloud.points[:, :2], axis=1)
        assert result.report["on_curves"] == 0
        assert np.median(radius) == pytest.approx(0.02, rel=0.1)
