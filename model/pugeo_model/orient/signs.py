# SPDX-License-Identifier: Apache-2.0
"""Signs of normals from directions, from the input's own normals and from other normals."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["orient_along", "orient_by_input", "row_dots", "transfer_signs"]


def orient_along(normals: NDArray[Any], directions: NDArray[Any]) -> NDArray[Any]:
    """Flip normals so that each has a non-negative dot product with its direction.

    Args:
        normals: ``(M, 3)`` float, of any sign.
        directions: ``(M, 3)`` float, of any length.

    Returns:
        ``(M, 3)`` of the dtype of ``normals``.
    """
    return _flip(normals, _signs(row_dots(normals, directions)))


def orient_by_input(
    normals: NDArray[Any], given: NDArray[Any], neighbours: NDArray[np.integer[Any]]
) -> NDArray[Any]:
    """Give normals the signs of the input's own normals.

    Points whose input normal is zero (or perpendicular) follow the majority of their neighbours.

    Args:
        normals: ``(M, 3)`` float, unit length, of any sign.
        given: ``(M, 3)`` float, the input's own, of any length.
        neighbours: ``(M, k)`` rows near each point; numbers outside ``0..M-1`` are skipped.

    Returns:
        ``(M, 3)`` of the dtype of ``normals``.
    """
    agreement = row_dots(normals, given)
    signs = _signs(agreement)
    unknown = np.flatnonzero(agreement == 0)
    if len(unknown):
        near = neighbours[unknown]
        valid = (near >= 0) & (near < len(normals))
        near = np.where(valid, near, 0)
        # Neighbours whose own sign is unknown have no vote.
        votes = np.sign(agreement)[near] * valid
        cosines = np.einsum("ij,ikj->ik", normals[unknown], normals[near])
        signs[unknown] = _signs((votes * cosines).sum(axis=1))
    return _flip(normals, signs)


def transfer_signs(
    normals: NDArray[Any], nearest: NDArray[np.integer[Any]], oriented: NDArray[Any]
) -> NDArray[Any]:
    """Give each dense normal the sign of the nearest oriented normal.

    Args:
        normals: ``(K, 3)`` float, of any sign.
        nearest: ``(K,)`` row of ``oriented`` for each dense normal.
        oriented: ``(M, 3)`` float.

    Returns:
        ``(K, 3)`` of the dtype of ``normals``.
    """
    return orient_along(normals, oriented[nearest])


def row_dots(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Dot products of corresponding rows, ``(N, 3)`` and ``(N, 3)`` -> ``(N,)``."""
    products: NDArray[Any] = np.einsum("ij,ij->i", left, right)
    return products


def _flip(normals: NDArray[Any], signs: NDArray[np.float64]) -> NDArray[Any]:
    flipped: NDArray[Any] = normals * signs[:, None].astype(normals.dtype)
    return flipped


def _signs(values: NDArray[Any]) -> NDArray[np.float64]:
    """-1 for negative values, otherwise 1: never 0."""
    return np.where(values < 0, -1.0, 1.0)
