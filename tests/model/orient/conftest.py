# SPDX-License-Identifier: Apache-2.0
"""Points of surfaces with known normals."""

import numpy as np
import pytest


class Surfaces:
    """Random points of surfaces, and random signs."""

    def ball(self, count, seed=0):
        """Points of the unit sphere, which are their own normals."""
        points = np.random.default_rng(seed).normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        return points

    def torus(self, count):
        """Points and outward normals of a torus, which is not convex."""
        u, v = np.random.default_rng(1).random((2, count)) * 2 * np.pi
        normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
        return np.stack([np.cos(u), np.sin(u), 0 * u], axis=1) + 0.4 * normals, normals

    def box(self, count, size):
        """Points and outward normals of a box."""
        rng = np.random.default_rng(2)
        area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        axis = rng.choice(3, count, p=area / area.sum())
        side = rng.choice([-1.0, 1.0], count)
        points = (rng.random((count, 3)) - 0.5) * size
        normals = np.zeros((count, 3))
        normals[np.arange(count), axis] = side
        points[np.arange(count), axis] = side * np.array(size)[axis] / 2
        return points, normals

    def mixed(self, normals, seed=0):
        """The normals with random signs, float32."""
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (len(normals), 1))
        return (normals * signs).astype(np.float32)


@pytest.fixture(scope="session")
def surfaces():
    """Random points of surfaces with known normals."""
    return Surfaces()
