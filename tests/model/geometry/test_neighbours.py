# SPDX-License-Identifier: Apache-2.0
import numpy as np

from pugeo_model.geometry.neighbours import nearest, spacing


def test_nearest_matches_brute_force(sphere):
    """The k nearest equal those of all pairwise distances, without the point itself."""
    distances, rows = nearest(sphere, 12)
    apart = np.linalg.norm(sphere[:, None] - sphere[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    expected = np.sort(apart, axis=1)[:, :12]
    np.testing.assert_allclose(distances, expected, rtol=1e-5)
    assert (rows != np.arange(len(sphere))[:, None]).all()


def test_few_points_repeat_the_furthest():
    """With fewer points than neighbours, the furthest is repeated and the shape is kept."""
    points = np.eye(3)
    distances, rows = nearest(points, 32)
    assert distances.shape == rows.shape == (3, 32)
    assert set(rows[0]) == {1, 2}


def test_spacing_is_the_mean_of_eight(plane):
    """The local spacing is the mean distance to the eight nearest."""
    distances, _ = nearest(plane[0], 32)
    np.testing.assert_allclose(spacing(distances), distances[:, :8].mean(axis=1))
