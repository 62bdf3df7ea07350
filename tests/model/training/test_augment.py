# SPDX-License-Identifier: Apache-2.0
"""Kinds of training inputs."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.training.augment import Mix, draw
from pugeo_model.training.corpus import SIZES, Shape

NONE = {"noisy": 0.0, "random": 0.0, "ramp": 0.0, "cut": 0.0, "lines": 0.0}


def only(kind: str | None) -> Mix:
    """A mix of one kind of input."""
    return Mix(**(NONE if kind is None else {**NONE, kind: 1.0}))


def is_part(points, whole) -> bool:
    """Return whether all points are points of the whole."""
    return float(np.max(cKDTree(whole).query(points)[0])) == 0.0


def test_clean_input_is_unchanged(shapes):
    """Without a kind, the input is a Poisson-disk sample of the shape."""
    points, noise = draw(shapes[0], only(None), np.random.default_rng(0))
    assert noise == 0.0
    np.testing.assert_array_equal(points, shapes[0].inputs[SIZES.index(len(points))])


def test_noisy_input_has_the_given_noise(shapes):
    """The distances from the sample have the returned standard deviation."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        points, noise = draw(shapes[0], only("noisy"), rng)
        original = shapes[0].inputs[SIZES.index(len(points))]
        assert (points - original).std() == pytest.approx(noise, rel=0.05)


@pytest.mark.parametrize("kind", ["ramp", "cut"])
def test_parts_of_a_sample(shapes, kind):
    """A ramp and a cut keep some of the points of a sample, without noise."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        points, noise = draw(shapes[0], only(kind), rng)
        assert noise == 0.0
        sizes = [size for size in SIZES if len(points) <= size]
        assert any(is_part(points, shapes[0].inputs[SIZES.index(size)]) for size in sizes)
        assert len(points) > SIZES[0] // 5


def test_random_input_comes_from_the_pool(shapes):
    """Random input has one of the sizes, and without noise its points are from the pool."""
    rng, clean = np.random.default_rng(0), 0
    for _ in range(10):
        points, noise = draw(shapes[0], only("random"), rng)
        assert len(points) in SIZES
        if noise == 0.0:
            assert is_part(points, shapes[0].pool.astype(np.float64))
            clean += 1
    assert 0 < clean < 10


def test_thin_shapes_have_scan_lines_too():
    """In any direction, some scan lines hit a needle."""
    rng = np.random.default_rng(0)
    pool = (rng.random((20_000, 3)) * [1, 0.01, 0.01]).astype(np.float32)
    none = np.empty((0, 3))
    inputs = (pool.astype(float),) * len(SIZES)
    needle = Shape("needle", none, none.astype(int), none, pool, inputs)
    for _ in range(300):
        assert len(draw(needle, only("lines"), rng)[0]) > 300


def test_the_same_numbers_give_the_same_input(shapes):
    """An input depends on the random numbers only."""
    one, two = (draw(shapes[0], Mix(), np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one[0], two[0])
    assert one[1] == two[1]
