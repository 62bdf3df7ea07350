# SPDX-License-Identifier: Apache-2.0
"""Virtual sensors: their points lie on what they see, and training can use them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.mesh.virtual_sensors import SENSORS, Scene, Surface, dense
from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import Batches

pytest.importorskip("trimesh", reason="virtual sensors need the train extra")
pytest.importorskip("embreex", reason="virtual sensors need the train extra")


def surface(shape):
    """The mesh of a training shape."""
    return Surface(shape.vertices, shape.faces, shape.normals, shape.pool)


@pytest.mark.parametrize("name", SENSORS)
def test_points_of_a_sensor_lie_near_the_surface(shapes, name):
    """Points are as far from the true surface as the noise says; the same seed gives the same."""
    scene = Scene(surface(shapes[0]))
    scan = SENSORS[name](scene, np.random.default_rng(3))
    again = SENSORS[name](scene, np.random.default_rng(3))
    np.testing.assert_array_equal(scan.points, again.points)
    assert len(scan.points) > 300
    pool = shapes[0].pool.astype(np.float64)
    sampling = float(np.median(np.asarray(cKDTree(pool).query(pool, k=2)[0])[:, 1]))
    distance = cKDTree(pool).query(scan.points)[0]
    assert np.median(distance) < 2.0 * scan.noise + 2.0 * sampling


def test_a_sensor_sees_one_side(shapes):
    """Of a ball a single scanner sees less than half of the surface, and its own points."""
    scene = Scene(surface(shapes[0]))
    scan = SENSORS["rings"](scene, np.random.default_rng(0))
    seen = scan.is_seen(shapes[0].pool.astype(np.float64))
    assert 0.1 < seen.mean() < 0.5


def test_dense_points_are_noisy(shapes):
    """Dense inputs have noise and many points."""
    scan = dense(shapes[0].pool, np.random.default_rng(1))
    assert len(scan.points) >= 8000
    assert scan.noise > 0.0


def test_batches_with_sensors_are_patches_with_truths(shapes):
    """A mix of scans and dense inputs gives samples like any other, and the same ones again."""
    mix = Mix(noisy=0, random=0, ramp=0, cut=0, lines=0, sensors=0.6, dense=0.4)
    one, two = (Batches(shapes, mix, 3, 10) for _ in range(2))
    for first, second in zip(one[2][1], two[2][1], strict=True):
        np.testing.assert_array_equal(first.patch.points, second.patch.points)
        assert np.isfinite(first.patch.points).all()
        assert len(first.truths) > 20
        assert first.noise >= 0.0
