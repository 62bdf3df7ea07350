# SPDX-License-Identifier: Apache-2.0
"""Exact nearest points on meshes, for the loss and for the metrics."""

import igl
import numpy as np
from numpy.typing import NDArray

__all__ = ["MeshDistance"]


class MeshDistance:
    """Nearest surface points of one mesh, by a bounding-volume tree built once.

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
        """Distances ``(K,)``, faces ``(K,)`` and nearest surface points ``(K, 3)``."""
        squared, face, foot = self._tree.squared_distance(
            self._vertices, self._faces, np.ascontiguousarray(points, dtype=np.float64)
        )
        return np.sqrt(squared), face, foot
