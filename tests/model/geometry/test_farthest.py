# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.farthest import farthest_points


def plain(points, count, given=()):
    """The textbook algorithm: all distances to every choice."""
    apart = np.full(len(points), np.inf)
    for point in given:
        apart = np.minimum(apart, ((points - point) ** 2).sum(axis=1))
    first = np.linalg.norm(points - points.mean(axis=0), axis=1).argmax()
    chosen = []
    for turn in range(count):
        chosen.append(first if turn == 0 and len(given) == 0 else apart.argmax())
        apart = np.minimum(apart, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        apart[chosen[-1]] = -1.0
    return np.array(chosen)


@pytest.mark.parametrize("count", [1, 2, 700, 2000])
def test_it_is_the_plain_algorithm(sphere, count):
    """Buckets change nothing: the same points in the same order, to the last."""
    moved = sphere + np.random.default_rng(0).normal(0, 1e-3, sphere.shape)
    np.testing.assert_array_equal(farthest_points(moved, count), plain(moved, count))


def test_points_that_are_given_count_as_chosen(sphere):
    """The next are the farthest from them, and they are not chosen themselves."""
    moved = sphere + np.random.default_rng(0).normal(0, 1e-3, sphere.shape)
    given = moved[:40] + 1e-6
    np.testing.assert_array_equal(farthest_points(moved, 500, given), plain(moved, 500, given))


def test_points_on_one_spot_are_chosen_once_each():
    """Where spots run out, the rest follows, no row twice."""
    points = np.repeat(np.eye(3), 50, axis=0)
    rows = farthest_points(points, 150)
    assert sorted(rows) == list(range(150))
    assert len(np.unique(points[rows[:3]], axis=0)) == 3


def test_none_and_too_many():
    """Nothing from nothing; more than there are is refused."""
    assert len(farthest_points(np.empty((0, 3)), 0)) == 0
    with pytest.raises(ValueError, match=r"0\.\.4"):
        farthest_points(np.zeros((4, 3)), 5)
