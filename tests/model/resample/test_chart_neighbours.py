# SPDX-License-Identifier: Apache-2.0
import numpy as np

from pugeo_model.geometry.neighbours import nearest
from pugeo_model.resample.chart_neighbours import chart_neighbours
from pugeo_model.resample.nearest_charts import nearest_charts


def test_neighbours_equal_brute_force(sphere):
    """The search in a few charts finds all samples within the radius."""
    rng = np.random.default_rng(0)
    owner = np.repeat(np.arange(len(sphere), dtype=np.int32), 4)
    samples = sphere[owner] + rng.normal(0, 0.01, (len(owner), 3))
    _, neighbours = nearest(sphere, 12)
    radius = np.full(len(owner), 0.02)
    found = chart_neighbours(samples, owner, neighbours, radius, 32)
    for i in range(0, len(samples), 97):
        distance = np.linalg.norm(samples - samples[i], axis=1)
        expected = set(np.flatnonzero(distance < 0.02)) - {i}
        assert set(found[i][found[i] >= 0]) == expected


def test_nearest_charts_are_sorted_and_right(sphere):
    """The charts of a query are the input points nearest to it, nearest first."""
    rng = np.random.default_rng(0)
    owner = np.arange(len(sphere), dtype=np.int32)
    queries = sphere + rng.normal(0, 0.01, sphere.shape)
    _, neighbours = nearest(sphere)
    found = nearest_charts(queries, owner, sphere, neighbours, 3)
    distance = np.linalg.norm(queries[:, None] - sphere[None], axis=-1)
    np.testing.assert_array_equal(found, np.argsort(distance, axis=1)[:, :3])
