# SPDX-License-Identifier: Apache-2.0
"""Distances between a predicted and a reference cloud, both with longest side 1."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn

__all__ = ["chamfer", "evenness", "hausdorff", "jensen_shannon", "nearest_both", "sphere_distances"]

_GRID = 28


def nearest_both(
    prediction: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the distances from each prediction to the nearest reference, and vice versa.

    Args:
        prediction: ``(K, 3)``.
        reference: ``(L, 3)``.

    Returns:
        ``(K,)`` and ``(L,)``.
    """
    there, _ = knn(cKDTree(reference), prediction, 1)
    back, _ = knn(cKDTree(prediction), reference, 1)
    return there[:, 0], back[:, 0]


def chamfer(there: NDArray[np.float64], back: NDArray[np.float64]) -> float:
    """Chamfer distance CD: half the sum of both mean nearest distances (not squared)."""
    return float(there.mean() + back.mean()) / 2


def hausdorff(there: NDArray[np.float64], back: NDArray[np.float64]) -> float:
    """Hausdorff distance HD: the larger of both largest nearest distances."""
    return float(max(there.max(), back.max()))


def jensen_shannon(prediction: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Jensen-Shannon divergence JSD of both densities on a 28^3 grid of the unit cube, 0..1 bit."""
    p, q = _histogram(prediction), _histogram(reference)
    middle = (p + q) / 2
    return (_divergence(p, middle) + _divergence(q, middle)) / 2


def sphere_distances(
    prediction: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[float, float]:
    """Compute sCD and sHD: sums of mean and of largest squared nearest distances.

    Each cloud is first centred on its own mean and scaled to radius 1, as in the protocol of
    PU-GAN and its successors.
    """
    there, back = nearest_both(_to_sphere(prediction), _to_sphere(reference))
    means = float((there**2).mean() + (back**2).mean())
    return means, float((there**2).max() + (back**2).max())


def evenness(points: NDArray[np.float64]) -> float:
    """Coefficient of variation of nearest-neighbour distances; about 0.08 for Poisson disks."""
    distance = knn(cKDTree(points), points, 2)[0][:, 1]
    return float(distance.std() / distance.mean())


def _histogram(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fractions of the points in the cells of the grid."""
    cell = np.clip(((points + 0.5) * _GRID).astype(np.int64), 0, _GRID - 1)
    flat = (cell[:, 0] * _GRID + cell[:, 1]) * _GRID + cell[:, 2]
    return np.bincount(flat, minlength=_GRID**3) / len(points)


def _divergence(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    """Kullback-Leibler divergence in bits."""
    occupied = p > 0
    return float((p[occupied] * np.log2(p[occupied] / q[occupied])).sum())


def _to_sphere(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centre on the mean and scale to radius 1."""
    centred = points - points.mean(axis=0)
    scaled: NDArray[np.float64] = centred / np.linalg.norm(centred, axis=1).max()
    return scaled
