# SPDX-License-Identifier: Apache-2.0
"""Samples and face normals of triangle meshes."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.resample.elimination import eliminate, packing_radius

__all__ = ["face_normals", "poisson_disk", "surface_area", "uniform", "uniform_with_faces"]

_OVERSAMPLING = 5  # candidates per sample, as Yuksel (2015) recommends
_NEIGHBOURS = 28  # of a candidate within the packing radius at most, including itself


def face_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute unit normals of faces; zero for a face without area.

    Args:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.

    Returns:
        ``(F, 3)`` float64.
    """
    normals = _edge_products(vertices, faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: NDArray[np.float64] = normals / np.maximum(length, 1e-300)
    return unit


def uniform(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw independent samples, uniform by area (Osada et al. 2002).

    Args:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        count: number of samples.
        rng: source of random numbers.

    Returns:
        ``(count, 3)`` float64.
    """
    return uniform_with_faces(vertices, faces, count, rng)[0]


def uniform_with_faces(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Draw samples as `uniform` does; also returns the face of each, ``(count,)``."""
    area = np.linalg.norm(_edge_products(vertices, faces), axis=1)
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    samples: NDArray[np.float64] = np.einsum("nc,ncd->nd", weights, vertices[faces][chosen])
    return samples, chosen


def surface_area(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Compute the area of a mesh."""
    return 0.5 * float(np.linalg.norm(_edge_products(vertices, faces), axis=1).sum())


def poisson_disk(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw an even sample by weighted sample elimination (Yuksel 2015).

    Args:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        count: number of samples.
        rng: source of random numbers.

    Returns:
        ``(count, 3)`` float64.
    """
    area = surface_area(vertices, faces) / count
    candidates = uniform(vertices, faces, _OVERSAMPLING * count, rng)
    radius = np.full(len(candidates), packing_radius(np.array(area)))
    distance, rows = knn(cKDTree(candidates), candidates, _NEIGHBOURS, radius[0])
    # The first neighbour is the candidate itself.
    neighbours = np.where(np.isfinite(distance), rows, -1)[:, 1:].astype(np.int32)
    return candidates[eliminate(candidates, neighbours, radius, count)]


def _edge_products(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Cross products of two edges of each face ``(F, 3)``: normal times twice the area."""
    corner = vertices[faces]
    products: NDArray[np.float64] = np.cross(
        corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    )
    return products
