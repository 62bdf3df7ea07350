# SPDX-License-Identifier: Apache-2.0
"""The sphere and the cube of the paper's last figure: even samples with known geometry."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.mesh.sampling import poisson_disk

__all__ = ["Solid", "cube", "sphere"]


@dataclass(frozen=True, eq=False)
class Solid:
    """An even sample of a solid of size 1.

    Attributes:
        name: of the solid.
        points: ``(M, 3)`` float64.
        normals: ``(M, 3)`` float64 unit, outward.
        curvature: both principal curvatures away from edges, sign ignored.
        flat: ``(M,)`` distance to the nearest edge; infinite where there is none.
    """

    name: str
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    curvature: float
    flat: NDArray[np.float64]


def sphere(count: int = 5000) -> Solid:
    """A sphere of diameter 1: both principal curvatures are 2."""
    rng = np.random.default_rng(count)
    theta = np.linspace(0.0, np.pi, 65)
    phi = np.linspace(0.0, 2.0 * np.pi, 128, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    grid = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    row, column = np.mgrid[:64, :128]
    a, b = 128 * row + column, 128 * row + (column + 1) % 128
    faces = np.concatenate(
        [np.stack([a, a + 128, b], -1), np.stack([b, a + 128, b + 128], -1)]
    ).reshape(-1, 3)
    points = poisson_disk(0.5 * grid.reshape(-1, 3), faces, count, rng)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    return Solid("sphere", 0.5 * normals, normals, 2.0, np.full(count, np.inf))


def cube(count: int = 5000) -> Solid:
    """A cube of side 1, edges and all: its faces have no curvature."""
    rng = np.random.default_rng(count)
    vertices: list[NDArray[np.float64]] = []
    faces: list[tuple[int, int, int]] = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            start = len(vertices)
            for u, v in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
                vertices.append(np.insert([u, v], axis, side))
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    points = poisson_disk(np.array(vertices), np.array(faces), count, rng)
    size = np.sort(np.abs(points), axis=1)
    face = np.abs(points).argmax(axis=1)
    normals = np.zeros_like(points)
    rows = np.arange(count)
    normals[rows, face] = np.sign(points[rows, face])
    return Solid("cube", points, normals, 0.0, 0.5 - size[:, 1])
