# SPDX-License-Identifier: Apache-2.0
"""Small surfaces with known normals and curvature."""

import numpy as np
import pytest


def fibonacci_sphere(count):
    """Even points of the unit sphere; the points are their own normals."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    angle = index * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def jittered_grid(count, seed=0):
    """Even but not regular points of the unit square, z = 0."""
    side = int(np.sqrt(count))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    moved = (grid + np.random.default_rng(seed).uniform(-0.3, 0.3, grid.shape)) / side
    return np.concatenate([moved, np.zeros((len(moved), 1))], axis=1)


@pytest.fixture
def sphere():
    """2,000 points of the unit sphere."""
    return fibonacci_sphere(2000)


@pytest.fixture
def plane():
    """1,600 points of a tilted plane, and its unit normal."""
    points = jittered_grid(1600)
    normal = np.array([0.3, -0.5, 0.8])
    normal /= np.linalg.norm(normal)
    first = np.cross(normal, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    return points[:, :1] * first + points[:, 1:2] * np.cross(normal, first), normal


@pytest.fixture
def cylinder():
    """2,000 points of a cylinder of radius 0.5 along z, height 2."""
    flat = jittered_grid(2025)[:, :2]
    angle = 2.0 * np.pi * flat[:, 0]
    return np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), 2.0 * flat[:, 1]], axis=1)


@pytest.fixture
def cube():
    """2,400 points of the surface of the unit cube, and their face normals."""
    points, normals = [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            face = jittered_grid(400, seed=2 * axis + int(side))[:, :2]
            points.append(np.insert(face, axis, side, axis=1))
            normals.append(np.tile(np.eye(3)[axis], (len(face), 1)))
    return np.concatenate(points), np.concatenate(normals)
