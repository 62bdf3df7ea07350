# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")


@pytest.fixture
def poisson():
    """The reconstruction, if its library is installed."""
    pytest.importorskip("pycolmap", reason="reconstruction needs the evaluate extra")
    from pugeo_model.metrics.reconstruction import reconstruct

    return reconstruct


def flat(height):
    """A unit square at a height as a mesh of two triangles."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return np.insert(corners, 2, height, axis=1), np.array([[0, 1, 2], [0, 2, 3]])


def test_a_sphere_comes_back(poisson, sphere):
    """Points of a sphere with outward normals give one closed surface on the sphere."""
    vertices, faces = poisson(0.5 * sphere, sphere, 7)
    radius = np.linalg.norm(vertices, axis=1)
    assert np.abs(radius - 0.5).max() < 2e-3
    assert np.abs(radius - 0.5).mean() < 3e-4
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(vertices) - len(edges) + len(faces) == 2  # Euler: no handle, one piece
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert ((normal * corner[:, 0]).sum(axis=1) > 0).mean() > 0.999


def test_the_same_points_give_the_same_surface(poisson, sphere):
    """A second run gives the same mesh, bit for bit."""
    once, again = (poisson(0.5 * sphere, sphere, 6) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))


def test_a_shifted_surface(square):
    """A square 0.1 above the true one has CD# 10 (1e-2), a slightly larger HD#, and JSD# 1 bit."""
    from pugeo_model.metrics.evaluation import Truth, measure_surface

    row = measure_surface(flat(0.1), Truth(square))
    assert row["CD#"] == pytest.approx(10.0, rel=1e-3)
    assert row["HD#"] == pytest.approx(10.0, rel=1e-2)
    assert row["HD#"] > row["CD#"]
    assert row["JSD#"] == pytest.approx(100.0)


def test_the_floor_of_the_columns(square):
    """The true surface has the CD# of two independent samples, sqrt(area / 200000) / 2."""
    from pugeo_model.metrics.evaluation import Truth, measure_surface

    row = measure_surface(flat(0.0), Truth(square))
    assert row["CD#"] == pytest.approx(100 * 0.5 * np.sqrt(1 / 200_000), rel=0.02)
    assert row["JSD#"] < 0.2


def test_without_the_library(monkeypatch):
    """Without pycolmap the error names the extra to install."""
    from pugeo_model.metrics.reconstruction import library

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'pugeo\[evaluate\]") as caught:
        library()
    assert caught.value.name == "pycolmap"
