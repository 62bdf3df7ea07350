# SPDX-License-Identifier: Apache-2.0
"""Exact nearest points on triangle meshes."""

import igl
import numpy as np
from numpy.typing import NDArray

__all__ = ["MeshDistance"]


class MeshDistance:
    """Nearest points on one mesh, by a bounding-volume tree that is built once.

    Args:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
    """

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def nearest(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Find the nearest point of the surface for each of the points ``(K, 3)``.

        Returns:
            Distances ``(K,)`` float64, faces ``(K,)`` int64, nearest points ``(K, 3)`` float64.
        """
        squared, face, foot = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points, dtype=np.float64)
        )
        return np.sqrt(squared), face, foot
