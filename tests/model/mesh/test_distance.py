# SPDX-License-Identifier: Apache-2.0
"""Nearest points on meshes."""

import numpy as np
import pytest

pytest.importorskip("igl", reason="distances need the train or evaluate extra")

from pugeo_model.mesh.distance import MeshDistance


def test_nearest_points_of_a_triangle():
    """Points above the inside, an edge and a corner have the known distance, face and foot."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -5], [1, 0, -5], [0, 1, -5]])
    mesh = MeshDistance(vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    queries = np.array([[0.2, 0.2, 0.3], [0.5, -2.0, 0.0], [-3.0, -4.0, 0.0], [0.1, 0.1, -4.5]])
    distance, face, foot = mesh.nearest(queries)
    expected = np.array([[0.2, 0.2, 0], [0.5, 0, 0], [0, 0, 0], [0.1, 0.1, -5]])
    assert distance == pytest.approx([0.3, 2.0, 5.0, 0.5])
    assert face.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(foot, expected, atol=1e-12)
