# SPDX-License-Identifier: Apache-2.0
"""Principal axes (PCA) of weighted neighbours, the start of each canonical frame."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit

__all__ = ["ball_covariance", "cross", "diagonalise", "principal_axes"]

_TINY = 1e-300


@njit(cache=True, nogil=True)
def principal_axes(
    local: NDArray[np.float64],
    weights: NDArray[np.float64],
    rows: NDArray[np.float64],
    work: NDArray[np.float64],
) -> None:
    """Compute the principal axes of weighted neighbours.

    Args:
        local: ``(3, k)`` offsets of the neighbours from the point; the point itself has weight 1.
        weights: ``(k,)``.
        rows: ``(3, 3)``, receives the axes by decreasing variance, right-handed.
        work: ``(6, 3)`` or larger, overwritten.
    """
    total, x, y, z, xx, xy, xz, yy, yz, zz = _second_moments(local, weights)
    matrix, vectors = work[:3, :3], work[3:, :3]
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = (
        xx - x * x / total,
        yy - y * y / total,
        zz - z * z / total,
    )
    matrix[0, 1] = matrix[1, 0] = xy - x * y / total
    matrix[0, 2] = matrix[2, 0] = xz - x * z / total
    matrix[1, 2] = matrix[2, 1] = yz - y * z / total
    diagonalise(matrix, vectors)
    first = second = 0
    for a in range(1, 3):
        if matrix[a, a] > matrix[first, first]:
            first = a
    second = 1 if first == 0 else 0
    for a in range(3):
        if a != first and matrix[a, a] > matrix[second, second]:
            second = a
    for a in range(3):
        rows[0, a] = vectors[a, first]
        rows[1, a] = vectors[a, second]
    cross(rows, 0, 1, 2)


@njit(cache=True, nogil=True)
def ball_covariance(local, weights, matrix):  # type: ignore[no-untyped-def]
    """Compute mean and covariance of the points of a ball, near its centre most.

    Args:
        local: ``(3, n)`` offsets of the points from the centre, in radii.
        weights: ``(n,)``, receives ``(1 - d^2)^2`` at the distance d, 0 beyond the ball.
        matrix: ``(3, 3)``, receives the covariance.

    Returns:
        The sum of the weights, above 0, and the mean x, y, z.
    """
    total = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    for j in range(local.shape[1]):
        a, b, c = local[0, j], local[1, j], local[2, j]
        w = max(1.0 - (a * a + b * b + c * c), 0.0)
        w *= w
        weights[j] = w
        total += w
        x += w * a
        y += w * b
        z += w * c
        xx += w * a * a
        xy += w * a * b
        xz += w * a * c
        yy += w * b * b
        yz += w * b * c
        zz += w * c * c
    total = max(total, _TINY)
    x, y, z = x / total, y / total, z / total
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = (
        xx / total - x * x,
        yy / total - y * y,
        zz / total - z * z,
    )
    matrix[0, 1] = matrix[1, 0] = xy / total - x * y
    matrix[0, 2] = matrix[2, 0] = xz / total - x * z
    matrix[1, 2] = matrix[2, 1] = yz / total - y * z
    return total, x, y, z


@njit(cache=True, nogil=True)
def cross(rows: NDArray[np.float64], a: int, b: int, to: int) -> None:
    """Set row ``to`` to the cross product of rows ``a`` and ``b``."""
    x = rows[a, 1] * rows[b, 2] - rows[a, 2] * rows[b, 1]
    y = rows[a, 2] * rows[b, 0] - rows[a, 0] * rows[b, 2]
    z = rows[a, 0] * rows[b, 1] - rows[a, 1] * rows[b, 0]
    rows[to, 0], rows[to, 1], rows[to, 2] = x, y, z


@njit(cache=True, nogil=True, fastmath=True)
def _second_moments(local, weights):  # type: ignore[no-untyped-def]
    """Sums of weights, weighted coordinates and weighted products of coordinates."""
    total, x, y, z = 1.0, 0.0, 0.0, 0.0
    xx = xy = xz = yy = yz = zz = 0.0
    for j in range(len(weights)):
        w, a, b, c = weights[j], local[0, j], local[1, j], local[2, j]
        total += w
        x += w * a
        y += w * b
        z += w * c
        xx += w * a * a
        xy += w * a * b
        xz += w * a * c
        yy += w * b * b
        yz += w * b * c
        zz += w * c * c
    return total, x, y, z, xx, xy, xz, yy, yz, zz


@njit(cache=True, nogil=True)
def diagonalise(matrix, vectors):  # type: ignore[no-untyped-def]
    """Diagonalise a symmetric 3x3 matrix by Jacobi rotations, in place.

    The columns of ``vectors`` become the eigenvectors.
    """
    for a in range(3):
        for b in range(3):
            vectors[a, b] = 1.0 if a == b else 0.0
    for _ in range(8):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off < 1e-12 * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for r in range(3):
                    x = matrix[r, p]
                    y = matrix[r, q]
                    matrix[r, p] = c * x - s * y
                    matrix[r, q] = s * x + c * y
                for r in range(3):
                    x = matrix[p, r]
                    y = matrix[q, r]
                    matrix[p, r] = c * x - s * y
                    matrix[q, r] = s * x + c * y
                for r in range(3):
                    x = vectors[r, p]
                    y = vectors[r, q]
                    vectors[r, p] = c * x - s * y
                    vectors[r, q] = s * x + c * y
