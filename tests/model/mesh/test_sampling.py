# SPDX-License-Identifier: Apache-2.0
"""Samples and face normals of meshes."""

import numpy as np
import pytest

from pugeo_model.mesh.sampling import face_normals, poisson_disk, uniform
from pugeo_model.metrics.clouds import evenness

VERTICES = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_face_normals():
    """Normals have unit length and the orientation of the faces; without area they are zero."""
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 1]])
    np.testing.assert_array_equal(face_normals(VERTICES, faces), [[0, 0, 1], [0, 0, -1], [0, 0, 0]])


def test_uniform_samples_are_uniform_by_area():
    """A face with three times the area gets three times the samples, inside the faces."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [10, 0, 0], [13, 0, 0], [10, 1, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    points = uniform(vertices, faces, 4000, np.random.default_rng(0))
    second = points[:, 0] > 5
    assert second.mean() == pytest.approx(0.75, abs=0.03)
    assert (points[~second, 0] + points[~second, 1] <= 1 + 1e-12).all()
    assert ((points[second, 0] - 10) / 3 + points[second, 1] <= 1 + 1e-12).all()
    assert (points >= 0).all()
    np.testing.assert_allclose(points[~second, :2].mean(axis=0), 1 / 3, atol=0.03)


def test_poisson_disk_is_exact_and_even():
    """The sample has exactly the requested number of points, on the mesh, evenly distributed."""
    points = poisson_disk(VERTICES, FACES, 1000, np.random.default_rng(0))
    assert points.shape == (1000, 3)
    assert np.abs(points[:, 2]).max() == 0.0
    assert evenness(points) < 0.1
    again = poisson_disk(VERTICES, FACES, 1000, np.random.default_rng(0))
    np.testing.assert_array_equal(points, again)
