# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.pca_normals import pca_normals


def test_a_plane_has_its_normal(plane):
    """Of either sign, to rounding."""
    points, normal = plane
    found = pca_normals(points)
    np.testing.assert_allclose(np.abs(found @ normal), 1.0, atol=1e-6)


@pytest.mark.parametrize("neighbours", [10, 15, 25, 35, 45])
def test_a_sphere_has_its_normals(sphere, neighbours):
    """For every number of neighbours of Table 2 within a degree on 2,000 points."""
    cosine = np.abs((pca_normals(sphere, neighbours) * sphere).sum(axis=1))
    assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).mean() < 1.0


def test_an_edge_by_hand():
    """Three points of the plane x = 0 and one beside it: the normal is x."""
    points = np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]])
    np.testing.assert_allclose(np.abs(pca_normals(points, 4)), np.tile([1.0, 0, 0], (5, 1)))
