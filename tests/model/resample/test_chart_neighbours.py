# SPDX-License-Identifier: Apache-2.0
import numpy as np

from pugeo_model.geometry.neighbours import nearest
from pugeo_model.resample.chart_neighbours import chart_neighbours
from pugeo_model.resample.selection import nearest_charts


def test_crowd_finds_what_brute_force_finds(sphere):
    """Searching a few charts finds every sample within radius."""
    rng = np.random.default_rng(0)
    owner = np.repeat(np.arange(len(sphere), dtype=np.int32), 4)
    samples = sphere[owner] + rng.normal(0, 0.01, (len(owner), 3))
    _, neighbours = nearest(sphere, 12)
    radius = np.full(len(owner), 0.02)
    found = chart_neighbours(samples, owner, neighbours, radius, 32)
    for i in range(0, len(samples), 97):
        apart = np.linalg.norm(samples - samples[i], axis=1)
        expected = set(np.flatnonzero(apart < 0.02)) - {i}
        assert set(found[i][found[i] >= 0]) == expected


def test_nearest_charts_are_sorted_and_right(sphere):
    """The charts of a spot are the input points nearest to it, nearest first."""
    rng = np.random.default_rng(0)
    owner = np.arange(len(sphere), dtype=np.int32)
    queries = sphere + rng.normal(0, 0.01, sphere.shape)
    _, neighbours = nearest(sphere)
    found = nearest_charts(queries, owner, sphere, neighbours, 3)
    apart = np.linalg.norm(queries[:, None] - sphere[None], axis=-1)
    np.testing.assert_array_equal(found, np.argsort(apart, axis=1)[:, :3])
