# SPDX-License-Identifier: Apache-2.0
"""Normals of 50,000 points at R = 1 under the six conditions of PCPNet (Guerrero et al. 2018)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.pca_normals import pca_normals
from pugeo_model.mesh.sampling import uniform_with_faces
from pugeo_model.metrics.evaluation import Truth, measure_normals
from pugeo_model.upsampler import Upsampler

__all__ = ["rows"]

_COUNT = 50_000
_NOISE = {"clean": 0.0, "noise .12 %": 0.0012, "noise .6 %": 0.006, "noise 1.2 %": 0.012}
"""Standard deviations over the diagonal of the bounding box."""

_STRIPES = 8  # dense and sparse bands along the longest axis
_SPARSE = 0.1  # share of points that a sparse band, or the sparse end, has left
_PCA = (16, 64, 256)


def rows(upsampler: Upsampler, truth: Truth) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Measure one shape: yields condition, method and the root mean square angle in degrees.

    The angle is that to the face that a point was drawn from, sign ignored. The methods ``PCA n``
    are the normals of least variance of n neighbours.
    """
    for name, points, face in _conditions(truth):
        true = truth.normals[face]
        ours = upsampler(Cloud(points.astype(np.float32)), 1.0).cloud.normals
        assert ours is not None
        yield name, "ours", _angle(ours, true)
        for count in _PCA:
            yield name, f"PCA {count}", _angle(pca_normals(points, count), true)


def _conditions(
    truth: Truth,
) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.intp]]]:
    """Name, points ``(50000, 3)`` and the faces that they were drawn from."""
    rng = np.random.default_rng(_COUNT)
    points, face = uniform_with_faces(truth.vertices, truth.faces, _COUNT, rng)
    diagonal = float(np.linalg.norm(np.ptp(truth.vertices, axis=0)))
    for name, share in _NOISE.items():
        yield name, points + rng.normal(0.0, share * diagonal, points.shape), face
    axis = int(np.ptp(truth.vertices, axis=0).argmax())
    for name in ("stripes", "gradient"):
        pool, faces = uniform_with_faces(truth.vertices, truth.faces, 4 * _COUNT, rng)
        along = pool[:, axis] - pool[:, axis].min()
        along /= along.max()
        dense = (along * _STRIPES).astype(int) % 2 == 0
        weight = np.where(dense, 1.0, _SPARSE) if name == "stripes" else _SPARSE ** (1 - along)
        chosen = rng.choice(len(pool), _COUNT, replace=False, p=weight / weight.sum())
        yield name, pool[chosen], faces[chosen]


def _angle(normals: NDArray[np.float32], true: NDArray[np.float64]) -> dict[str, float]:
    return {"normal_rms": measure_normals(normals, true)["normal_rms"]}
