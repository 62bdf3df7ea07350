# SPDX-License-Identifier: Apache-2.0
"""The expected error of output points: calibrated on closed forms, in the cloud's units."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from pugeo_model.upsampler import Upsampler

SIZE = 50.0  # radius, so that units matter


@pytest.fixture(scope="module")
def upsampler() -> Upsampler:
    """The released model."""
    torch.set_num_threads(1)
    return Upsampler()


def bumpy(count: int, noise: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of points of a bumpy ball, and the points with noise along each axis."""
    index = np.arange(count) + 0.5
    height, angle = 1 - 2 * index / count, index * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - height**2)
    unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    points = unit * radius(unit)[:, None]
    return unit, points + np.random.default_rng(0).normal(0, noise, points.shape)


def radius(unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radius of the bumpy ball in a direction."""
    waves: NDArray[np.float64] = SIZE * (1 + 0.06 * np.sin(unit @ [7.0, 3.0, -5.0]))
    return waves


def true_error(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance from the bumpy ball to first order."""
    length = np.linalg.norm(points, axis=1)
    unit = points / length[:, None]
    step = 1e-5
    slope = np.stack(
        [(radius(_unit(unit + step * axis)) - radius(unit)) / step for axis in np.eye(3)], axis=1
    )
    steepness = np.linalg.norm(slope, axis=1) / length
    error: NDArray[np.float64] = np.abs(length - radius(unit)) / np.sqrt(1 + steepness**2)
    return error


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


@pytest.mark.parametrize("noise", [0.6, 1.2])
def test_the_mean_is_that_of_the_true_error(upsampler: Upsampler, noise: float) -> None:
    """Said and true errors of a noisy scan agree in the mean, in its units."""
    cloud = upsampler(bumpy(3000, noise)[1], 4, confidence=True).cloud
    said, true = cloud.scalars["expected_error"], true_error(cloud.points)
    assert said.dtype == np.float32
    assert said.min() > 0
    assert 0.65 < true.mean() / said.mean() < 1.5


def test_where_more_is_said_more_is_true(upsampler: Upsampler) -> None:
    """A smooth surface without noise is known better than is said, and worst where it is said."""
    cloud = upsampler(bumpy(3000, 0.0)[1], 4, confidence=True).cloud
    said, true = cloud.scalars["expected_error"], true_error(cloud.points)
    assert 0.2 < true.mean() / said.mean() < 1.5
    order = np.argsort(said)
    low, high = order[: len(order) // 4], order[-len(order) // 4 :]
    assert true[high].mean() > 1.2 * true[low].mean()


def test_kept_points_keep_their_noise(upsampler: Upsampler) -> None:
    """Input points that stay as they are have the error of the scan, new ones a smaller one."""
    noise = 1.2
    _, points = bumpy(3000, noise)
    said = upsampler(points, 2, keep_input=True, confidence=True).cloud.scalars["expected_error"]
    true = true_error(points).mean()
    assert 0.5 < true / said[:3000].mean() < 2.0
    assert said[3000:].mean() < said[:3000].mean()


def test_it_is_there_only_if_asked_for(upsampler: Upsampler, sphere: NDArray[np.float32]) -> None:
    """Without the option there is no such scalar, and points are the same."""
    plain, told = upsampler(sphere, 2).cloud, upsampler(sphere, 2, confidence=True).cloud
    assert "expected_error" not in plain.scalars
    np.testing.assert_array_equal(plain.points, told.points)
    scaled = upsampler(1000 * sphere, 2, confidence=True).cloud
    np.testing.assert_allclose(
        scaled.scalars["expected_error"], 1000 * told.scalars["expected_error"], rtol=0.05
    )
