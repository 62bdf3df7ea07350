# SPDX-License-Identifier: Apache-2.0
"""Normals by principal component analysis of each point's neighbours."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.neighbours import nearest

__all__ = ["PCA_NEIGHBOURS", "pca_normals"]

PCA_NEIGHBOURS = 16
"""Neighbours that the paper takes for methods without normals (section 4.2)."""


def pca_normals(
    points: NDArray[np.float64], neighbours: int = PCA_NEIGHBOURS
) -> NDArray[np.float32]:
    """Direction of least variance of the ``neighbours`` nearest points and the point itself.

    Args:
        points: ``(M, 3)`` float64, two at least.
        neighbours: of each point.

    Returns:
        ``(M, 3)`` float32 unit normals of either sign.
    """
    _, rows = nearest(points, neighbours)
    around = np.concatenate([points[:, None], points[rows]], axis=1)
    around -= around.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(around.transpose(0, 2, 1) @ around)
    return vectors[:, :, 0].astype(np.float32)
