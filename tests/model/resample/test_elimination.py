# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.metrics.clouds import evenness
from pugeo_model.resample.elimination import eliminate, packing_radius


def setup(count=5000, keep=1000):
    """Random points of a unit square, their neighbours and radii."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((count, 2)), np.zeros((count, 1))], axis=1)
    radius = np.full(count, packing_radius(np.array(1.0 / keep)))
    distance, rows = cKDTree(points).query(points, 28, distance_upper_bound=radius[0])
    neighbours = np.where(np.isfinite(distance), rows, -1)[:, 1:]
    return points, neighbours.astype(np.int32), radius


@pytest.mark.parametrize("keep", [0, 1, 999, 5000])
def test_exactly_as_many_as_asked(keep):
    """The number of survivors is exact, from none to all."""
    points, rows, radius = setup()
    kept = eliminate(points, rows, radius, keep)
    assert len(kept) == keep == len(set(kept))


def test_survivors_are_even():
    """A random cloud becomes a Poisson-disk sample (random: 0.52, Poisson disk: about 0.08)."""
    points, rows, radius = setup()
    assert evenness(points) > 0.5
    assert evenness(points[eliminate(points, rows, radius, 1000)]) < 0.1


def test_a_penalty_removes_candidates_first():
    """Candidates with a penalty survive less often than the others."""
    points, rows, radius = setup()
    penalty = np.where(np.arange(5000) % 2, 0.5, 0.0)
    kept = eliminate(points, rows, radius, 1000, penalty)
    assert (kept % 2 == 1).mean() < 0.2


def test_a_penalty_removes_an_outlier():
    """A candidate without neighbours is removed if it has a penalty, and kept otherwise."""
    points, rows, radius = setup()
    points = np.append(points, [[0.5, 0.5, 3.0]], axis=0)
    rows = np.append(rows, np.full((1, rows.shape[1]), -1, dtype=np.int32), axis=0)
    radius = np.append(radius, radius[0])
    penalty = np.append(np.zeros(5000), 5.0)
    assert 5000 in eliminate(points, rows, radius, 1000)
    assert 5000 not in eliminate(points, rows, radius, 1000, penalty)


def test_level_changes_weights_near_the_end():
    """It is called once with the remaining candidates; larger factors remove more of them."""
    points, rows, radius = setup()
    left = points[:, 0] < 0.5
    calls = []

    def level(alive):
        calls.append(alive.sum())
        return np.where(left, 10.0, 1.0)

    even, tilted = (eliminate(points, rows, radius, 1000, level=f) for f in (None, level))
    assert calls == [1300]
    assert len(tilted) == 1000
    assert 0.48 < left[even].mean() < 0.52
    assert left[tilted].mean() < left[even].mean() - 0.04


def test_impossible_count_is_refused():
    """More survivors than candidates is an error."""
    points, rows, radius = setup()
    with pytest.raises(ValueError, match="keep must lie in"):
        eliminate(points, rows, radius, 5001)
