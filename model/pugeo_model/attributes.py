# SPDX-License-Identifier: Apache-2.0
"""Colours, continuous quantities and labels for new points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud

__all__ = ["NEIGHBOURS", "transfer_attributes"]

NEIGHBOURS = 3
"""Source points that a colour or a continuous quantity is neighbour_mean over."""

_BLOCK_ROWS = 65_536


def transfer_attributes(
    source: Cloud, targets: NDArray[np.float64], nearest: NDArray[np.integer[Any]] | None = None
) -> tuple[NDArray[np.uint8] | None, dict[str, NDArray[Any]]]:
    """Give new points what the source points transfer_attributes.

    Colours and floating point scalars are the mean over the three nearest source points,
    weighted by inverse distance; a target on a source point takes that one's value. Values that
    are not finite are left out of the mean, and stay only where the nearest ones have no other.
    Integer and boolean scalars are labels: a mean of two classes would be a third, so they are
    those of the nearest point.

    Args:
        source: ``M`` points (at least one, all finite) with colours and scalars.
        targets: ``(K, 3)`` float64, in the source's frame.
        nearest: ``(K, k)`` rows of the source nearest to each target, nearest first, where they
            are known already. Found with a k-d tree where ``None``.

    Returns:
        ``(K, 3|4)`` uint8 colours or ``None``, and scalars ``(K,)`` of the source's dtypes.
    """
    if source.colors is None and not source.scalars:
        return None, {}
    count = len(targets)
    colors = None if source.colors is None else np.empty((count, source.colors.shape[1]), np.uint8)
    scalars = {name: np.empty(count, values.dtype) for name, values in source.scalars.items()}
    points = source.points.astype(np.float64, copy=False)
    wanted = min(NEIGHBOURS, len(points))
    # A list of ranks keeps the result two-dimensional where a single neighbour is wanted.
    ranks = np.arange(1, wanted + 1)
    tree = cKDTree(points if nearest is None else points[:0])
    for start in range(0, count, _BLOCK_ROWS):
        part = slice(start, start + _BLOCK_ROWS)
        rows: NDArray[Any]
        if nearest is not None:
            rows = nearest[part, :wanted]
        else:
            rows = np.asarray(tree.query(targets[part], k=ranks)[1])
        weights = _weights(points, targets[part], rows)
        if colors is not None and source.colors is not None:
            mean = np.einsum("kn,knc->kc", weights, source.colors[rows])
            colors[part] = np.rint(mean / weights.sum(axis=1, keepdims=True))
        for name, values in source.scalars.items():
            if values.dtype.kind == "f":
                scalars[name][part] = _mean(values[rows], weights)
            else:
                scalars[name][part] = values[rows[:, 0]]
    return colors, scalars


def _weights(
    points: NDArray[np.float64], targets: NDArray[np.float64], rows: NDArray[Any]
) -> NDArray[np.float64]:
    """Inverse distances ``(K, k)``, relative to the nearest, which has weight 1."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        distances = np.linalg.norm(points[rows] - targets[:, None, :], axis=2)
        least = distances.min(axis=1, keepdims=True)
        weights = np.where(distances == least, 1.0, least / distances)
    # Distances beyond float64 (coordinates near 1e200) cannot be compared.
    return np.nan_to_num(weights, nan=0.0)


def _mean(values: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    finite = np.isfinite(values)
    used = np.where(finite, weights, 0.0)
    total = used.sum(axis=1)
    known = total > 0.0
    # Shares first, and clipped: a sum of values near the largest float would overflow.
    shares = used / np.where(known, total, 1.0)[:, None]
    with np.errstate(over="ignore"):
        mean = (shares * np.where(finite, values, 0.0)).sum(axis=1)
    low = np.where(finite, values, np.inf).min(axis=1)
    high = np.where(finite, values, -np.inf).max(axis=1)
    return np.where(known, np.clip(mean, low, high), values[:, 0])
