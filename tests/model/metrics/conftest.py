# SPDX-License-Identifier: Apache-2.0
"""Mesh files of surfaces with known formulas."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull


def even_directions(count):
    """Evenly distributed unit vectors, ``(count, 3)``."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    angle = index * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def ball_mesh(radius, count=3000):
    """Vertices and outward faces of a sphere around the origin."""
    vertices = even_directions(count)
    faces = ConvexHull(vertices).simplices
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = (normal * corner[:, 0]).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return radius * vertices, faces.astype(np.int64)


def write_off(path, vertices, faces):
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [" ".join(f"{x:.9g}" for x in vertex) for vertex in vertices]
    lines += ["3 " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def ball(tmp_path_factory):
    """A sphere of radius 0.5, as a mesh file."""
    return write_off(tmp_path_factory.mktemp("ball") / "ball.off", *ball_mesh(0.5))


@pytest.fixture
def square(tmp_path):
    """A unit square in the plane z = 0, as a mesh file."""
    path = tmp_path / "square.off"
    path.write_text("OFF\n4 2 0\n-.5 -.5 0\n.5 -.5 0\n.5 .5 0\n-.5 .5 0\n3 0 1 2\n3 0 2 3\n")
    return path
