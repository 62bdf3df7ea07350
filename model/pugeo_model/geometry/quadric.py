# SPDX-License-Identifier: Apache-2.0
"""Fit of a quadric to the heights of weighted neighbours (jet fitting, Cazals and Pouget 2005)."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.pca import cross
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["QUADRIC", "fit_quadric", "solve", "tilt"]

QUADRIC = 6
"""Number of coefficients: ``h(u, v) = c0 + c1 u + c2 v + c3 u^2/2 + c4 u v + c5 v^2/2``."""

_RIDGE = TUNING.fit_ridge


@njit(cache=True, nogil=True)
def fit_quadric(
    local: NDArray[np.float64],
    weights: NDArray[np.float64],
    axes: NDArray[np.float64],
    gram: NDArray[np.float64],
    coefficients: NDArray[np.float64],
) -> float:
    """Fit a quadric by weighted ridge regression.

    Args:
        local: ``(3, k)`` offsets of the neighbours from the point; the point itself has weight 1.
        weights: ``(k,)``.
        axes: ``(3, 3)`` rows ``t1, t2, n`` of the frame.
        gram: ``(6, 6)`` work space, overwritten.
        coefficients: ``(6,)``, receives the result.

    Returns:
        The weighted RMS residual, in units of ``local``.
    """
    total, squares = _gram(local, weights, axes, gram, coefficients)
    e0, e1, e2 = coefficients[0], coefficients[1], coefficients[2]
    e3, e4, e5 = coefficients[3], coefficients[4], coefficients[5]
    for a in range(QUADRIC):
        gram[a, a] += _RIDGE * total / 8.0
    solve(gram, coefficients)
    squares -= e0 * coefficients[0] + e1 * coefficients[1] + e2 * coefficients[2]
    squares -= e3 * coefficients[3] + e4 * coefficients[4] + e5 * coefficients[5]
    return np.sqrt(max(squares, 0.0) / total)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, fastmath=True)
def _gram(local, weights, axes, gram, right):  # type: ignore[no-untyped-def]
    """Set up the normal equations; returns the sum of weights and of squared heights.

    Each sum is a scalar variable, so that all stay in registers.
    """
    a0, a1, a2 = axes[0, 0], axes[0, 1], axes[0, 2]
    b0, b1, b2 = axes[1, 0], axes[1, 1], axes[1, 2]
    c0, c1, c2 = axes[2, 0], axes[2, 1], axes[2, 2]
    total = su = sv = suu = suv = svv = 0.0
    suuu = suuv = suvv = svvv = suuuu = suuuv = suuvv = suvvv = svvvv = 0.0
    sh = shu = shv = shuu = shuv = shvv = shh = 0.0
    for j in range(len(weights)):
        x, y, z, w = local[0, j], local[1, j], local[2, j], weights[j]
        u = a0 * x + a1 * y + a2 * z
        v = b0 * x + b1 * y + b2 * z
        h = c0 * x + c1 * y + c2 * z
        wu, wv, wh = w * u, w * v, w * h
        uu, uv, vv = wu * u, wu * v, wv * v
        total += w
        su += wu
        sv += wv
        suu += uu
        suv += uv
        svv += vv
        suuu += uu * u
        suuv += uu * v
        suvv += vv * u
        svvv += vv * v
        suuuu += uu * u * u
        suuuv += uu * u * v
        suuvv += uu * v * v
        suvvv += vv * v * u
        svvvv += vv * v * v
        sh += wh
        shu += wh * u
        shv += wh * v
        shuu += uu * h
        shuv += uv * h
        shvv += vv * h
        shh += wh * h
    total += 1.0
    gram[0, 0] = total
    gram[1, 0], gram[1, 1] = su, suu
    gram[2, 0], gram[2, 1], gram[2, 2] = sv, suv, svv
    gram[3, 0], gram[3, 1], gram[3, 2] = 0.5 * suu, 0.5 * suuu, 0.5 * suuv
    gram[3, 3] = 0.25 * suuuu
    gram[4, 0], gram[4, 1], gram[4, 2] = suv, suuv, suvv
    gram[4, 3], gram[4, 4] = 0.5 * suuuv, suuvv
    gram[5, 0], gram[5, 1], gram[5, 2] = 0.5 * svv, 0.5 * suvv, 0.5 * svvv
    gram[5, 3], gram[5, 4], gram[5, 5] = 0.25 * suuvv, 0.5 * suvvv, 0.25 * svvvv
    right[0], right[1], right[2] = sh, shu, shv
    right[3], right[4], right[5] = 0.5 * shuu, shuv, 0.5 * shvv
    return total, shh


@njit(cache=True, nogil=True)
def solve(matrix, right):  # type: ignore[no-untyped-def]
    """Solve a symmetric positive definite system by Cholesky factorisation, in place."""
    for i in range(QUADRIC):
        for j in range(i + 1):
            total = matrix[i, j]
            for m in range(j):
                total -= matrix[i, m] * matrix[j, m]
            # The diagonal stores inverses, since a division takes as long as ten products.
            if i == j:
                matrix[i, i] = 1.0 / np.sqrt(max(total, 1e-12))
            else:
                matrix[i, j] = total * matrix[j, j]
    for i in range(QUADRIC):
        total = right[i]
        for m in range(i):
            total -= matrix[i, m] * right[m]
        right[i] = total * matrix[i, i]
    for i in range(QUADRIC - 1, -1, -1):
        total = right[i]
        for m in range(i + 1, QUADRIC):
            total -= matrix[m, i] * right[m]
        right[i] = total * matrix[i, i]


@njit(cache=True, nogil=True)
def tilt(frame, quadric):  # type: ignore[no-untyped-def]
    """Rotate a frame so that its normal is the normal of the fitted quadric at the point."""
    length = 1.0 / np.sqrt(1.0 + quadric[1] * quadric[1] + quadric[2] * quadric[2])
    along = 0.0
    for a in range(3):
        frame[2, a] = (frame[2, a] - quadric[1] * frame[0, a] - quadric[2] * frame[1, a]) * length
        along += frame[0, a] * frame[2, a]
    squared = 0.0
    for a in range(3):
        frame[0, a] -= along * frame[2, a]
        squared += frame[0, a] * frame[0, a]
    length = np.sqrt(max(squared, 1e-300))
    for a in range(3):
        frame[0, a] /= length
    cross(frame, 2, 0, 1)
