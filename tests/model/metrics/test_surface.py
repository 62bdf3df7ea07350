# SPDX-License-Identifier: Apache-2.0
"""Meshes of dense clouds: near their points, in their frame, open where the cloud is."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud, UntreatableCloudError
from pugeo_model.metrics.surface import surface_of

pytest.importorskip("pycolmap")
FAR = np.array([500_000.0, 5_400_000.0, 300.0])
RADIUS = 7.0


def ball(count: int = 6000) -> NDArray[np.float64]:
    """Even points of the unit sphere, which are their own normals."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = index * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def test_a_ball_far_from_the_origin() -> None:
    """A closed cloud becomes a closed mesh in the cloud's own frame, units and precision."""
    normals = ball()
    cloud = Cloud(RADIUS * normals + FAR, normals=normals.astype(np.float32))
    vertices, faces = surface_of(cloud)
    assert np.abs(np.linalg.norm(vertices - FAR, axis=1) - RADIUS).max() < 0.01 * RADIUS
    # Euler's formula: V - E + F = 2, with 3 F = 2 E.
    assert len(vertices) - len(faces) / 2 == 2
    assert sorted(np.unique(faces)) == list(range(len(vertices)))


def test_an_open_cloud_stays_open() -> None:
    """Half a ball gets no lid: no corner is farther from the points than twice their spacing."""
    normals = ball()
    normals = normals[normals[:, 2] > 0]
    vertices, _ = surface_of(Cloud(normals, normals=normals.astype(np.float32)))
    spacing = (4 * np.pi / 6000) ** 0.5
    assert vertices[:, 2].min() > -3 * spacing
    assert np.linalg.norm(vertices, axis=1).min() > 0.9
    everything, _ = surface_of(Cloud(normals, normals=normals.astype(np.float32)), near=np.inf)
    assert len(everything) > len(vertices)


def test_points_without_normals() -> None:
    """Without normals there is no mesh."""
    with pytest.raises(UntreatableCloudError, match="normals"):
        surface_of(Cloud(ball(100)))
