# SPDX-License-Identifier: Apache-2.0
"""Fit of a curve of degree two to the points of a ball: a wire, a single scan line.

The first principal axis is the parameter; along the two other axes a parabola is fitted by least
squares, with weights that fall to zero at the surface of the ball.
"""

import numpy as np

from pugeo_model.geometry.pca import ball_covariance, diagonalise
from pugeo_model.kernel_compiler import njit

__all__ = [
    "CURVE",
    "KURTOSIS",
    "LENGTH",
    "ORIGIN",
    "PARABOLA",
    "RADIUS",
    "curve_point",
    "fit_curve",
]

CURVE = 21
"""Number of results of a fit: the three principal axes (9), then the following."""
ORIGIN = 9
"""Index of the weighted mean of the points (3)."""
PARABOLA = 12
"""Index of the coefficients of 1, s, s^2 along the second axis, then along the third (6)."""
LENGTH = 18
"""Index of the standard deviation along the first principal axis."""
RADIUS = 19
"""Index of the standard deviation of the residuals across the curve, per axis."""

KURTOSIS = 20
"""Index of the kurtosis: mean fourth power of the distances from the curve over their squared mean
square. It is 2 for noise with a normal distribution, 1 for the surface of a pole."""

_PARAMETERS = 3.0  # of each parabola
_RIDGE = 1e-9
_TINY = 1e-300


@njit(cache=True, nogil=True)
def fit_curve(local, weights, work, out):  # type: ignore[no-untyped-def]
    """Fit a curve.

    Args:
        local: ``(3, n)`` float64 offsets of the points from the centre of the ball, in its radii.
        weights: ``(n,)``, overwritten.
        work: ``(6, 3)``, overwritten.
        out: ``(CURVE,)``, receives the results, in the frame of ``local``.
    """
    n = local.shape[1]
    matrix, vectors = work[:3], work[3:6]
    total, x, y, z = ball_covariance(local, weights, matrix)
    diagonalise(matrix, vectors)
    first = 0
    for a in range(1, 3):
        if matrix[a, a] > matrix[first, first]:
            first = a
    variance = max(matrix[first, first], 0.0)
    for a in range(3):
        out[a] = vectors[a, first]
        out[3 + a] = vectors[a, (first + 1) % 3]
        out[6 + a] = vectors[a, (first + 2) % 3]
    out[ORIGIN], out[ORIGIN + 1], out[ORIGIN + 2] = x, y, z
    out[LENGTH] = np.sqrt(variance)
    # s has the mean 0; t = s^2 is made orthogonal to it, so that no system has to be solved.
    third = fourth = spread = 0.0
    for j in range(n):
        w = weights[j]
        s, _, _ = _coordinates(local, j, out)
        third += w * s**3
        fourth += w * s**4
        spread += w * w
    skew = third / max(total * variance, _TINY)
    square = fourth / total - variance * variance - skew * skew * variance
    square = max(square, 0.0) + _RIDGE
    m1 = m2 = s1 = s2 = t1 = t2 = 0.0
    for j in range(n):
        w = weights[j]
        s, p, q = _coordinates(local, j, out)
        t = s * s - variance - skew * s
        m1 += w * p
        m2 += w * q
        s1 += w * s * p
        s2 += w * s * q
        t1 += w * t * p
        t2 += w * t * q
    scale = max(variance, _TINY) * total
    for k, (mean, slope, bend) in enumerate(((m1, s1, t1), (m2, s2, t2))):
        curvature = bend / (square * total)
        out[PARABOLA + 3 * k] = mean / total - curvature * variance
        out[PARABOLA + 3 * k + 1] = slope / scale - curvature * skew
        out[PARABOLA + 3 * k + 2] = curvature
    squares = fourths = 0.0
    for j in range(n):
        w = weights[j]
        s, p, q = _coordinates(local, j, out)
        a = p - (out[PARABOLA] + s * (out[PARABOLA + 1] + s * out[PARABOLA + 2]))
        b = q - (out[PARABOLA + 3] + s * (out[PARABOLA + 4] + s * out[PARABOLA + 5]))
        square = a * a + b * b
        squares += w * square
        fourths += w * square * square
    # Degrees of freedom: uneven weights stand for fewer points.
    several = total * total / max(spread, _TINY)
    free = several / max(several - _PARAMETERS, 0.5)
    out[RADIUS] = np.sqrt(0.5 * squares / total * free)
    out[KURTOSIS] = fourths * total / max(squares * squares, _TINY)


@njit(cache=True, nogil=True)
def curve_point(curve, x, y, z, low, high):  # type: ignore[no-untyped-def]
    """Return the point of a fitted curve beside a place.

    Args:
        curve: ``(CURVE,)``, see `fit_curve`.
        x, y, z: the place, in the frame of the fit.
        low, high: range of the parameter, the coordinate along the first axis.
    """
    a, b, c = x - curve[ORIGIN], y - curve[ORIGIN + 1], z - curve[ORIGIN + 2]
    s = a * curve[0] + b * curve[1] + c * curve[2]
    s = min(max(s, low), high)
    p = curve[PARABOLA] + s * (curve[PARABOLA + 1] + s * curve[PARABOLA + 2])
    q = curve[PARABOLA + 3] + s * (curve[PARABOLA + 4] + s * curve[PARABOLA + 5])
    return (
        curve[ORIGIN] + s * curve[0] + p * curve[3] + q * curve[6],
        curve[ORIGIN + 1] + s * curve[1] + p * curve[4] + q * curve[7],
        curve[ORIGIN + 2] + s * curve[2] + p * curve[5] + q * curve[8],
    )


@njit(cache=True, nogil=True)
def _coordinates(local, j, out):  # type: ignore[no-untyped-def]
    """Coordinates of a point along the three principal axes, from the mean."""
    a, b, c = (
        local[0, j] - out[ORIGIN],
        local[1, j] - out[ORIGIN + 1],
        local[2, j] - out[ORIGIN + 2],
    )
    return (
        a * out[0] + b * out[1] + c * out[2],
        a * out[3] + b * out[4] + c * out[5],
        a * out[6] + b * out[7] + c * out[8],
    )
