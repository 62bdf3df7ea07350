# SPDX-License-Identifier: Apache-2.0
"""Mesh of a dense cloud: screened Poisson reconstruction, cut off where there are no points.

Poisson reconstruction closes every hole, however large, and the cut that its own library offers is
by the density of points in its octree, whose default leaves nothing of clouds of this size. Here a
face stays if all its corners are near points of the cloud.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.errors import UntreatableCloudError
from pugeo_model.geometry.neighbours import SPACING_NEIGHBOURS, knn
from pugeo_model.metrics.reconstruction import DEPTH, Mesh, reconstruct
from pugeo_model.normalise import normalise

__all__ = ["NEAR", "surface_of"]

NEAR = 2.0
"""Distance of a corner from the nearest point up to which it stays, in spacings of the cloud.

Three closed shapes lose no face at it. Of their halves 0.2 to 1.6 % of the area is more than 0.5 %
of the size off the true surface, uncut 17 to 33 % (5,000 points at R = 4)."""

_SHALLOWEST = 6


def surface_of(cloud: Cloud, near: float = NEAR) -> Mesh:
    """Reconstruct the surface of a cloud with oriented normals.

    Args:
        cloud: with normals, such as the result of upsampling.
        near: corners of faces are at most so many spacings away from the nearest point, where the
            spacing is the median of the mean distances to the 8 nearest points.

    Returns:
        Vertices ``(V, 3)`` float64 in the frame and units of the cloud, and faces ``(F, 3)``.

    Raises:
        UntreatableCloudError: the cloud has no normals, or no face is near its points.
        ModuleNotFoundError: the library of the reconstruction is not installed.
    """
    if cloud.normals is None:
        raise UntreatableCloudError("A mesh needs points with normals.")
    # The reconstruction is in single precision, which large coordinates would not survive.
    points, frame = normalise(cloud.points)
    tree = cKDTree(points)
    spacing = _spacing(tree)
    # Cells as wide as the spacing: finer ones cost memory and show nothing more.
    depth = min(max(math.ceil(-math.log2(spacing)), _SHALLOWEST), DEPTH + 1)
    vertices, faces = reconstruct(points, cloud.normals, depth)
    distance = tree.query(vertices, distance_upper_bound=near * spacing)[0]
    vertices, faces = _kept(vertices, faces, np.isfinite(distance))
    if not len(faces):
        raise UntreatableCloudError(
            "The reconstructed surface is nowhere near the points: check that their normals agree."
        )
    return frame.scale * vertices + frame.offset, faces


def _spacing(tree: cKDTree) -> float:
    distances, _ = knn(tree, tree.data, SPACING_NEIGHBOURS + 1)
    return float(np.median(distances[:, 1:].mean(axis=1)))


def _kept(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], near: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Faces whose corners are all marked, and the vertices that they use."""
    faces = faces[near[faces].all(axis=1)]
    used = np.zeros(len(vertices), np.bool_)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]
