# SPDX-License-Identifier: Apache-2.0
"""Robust fit of a quadric to all points of a ball.

Weights fall to zero at the surface of the ball. The fit is repeated with Tukey's biweight of the
residuals, so that stray points and the other side of a thin wall lose their influence (robust
moving least squares, Fleishman, Cohen-Or and Silva 2005).
"""

import numpy as np

from pugeo_model.geometry.pca import ball_covariance, cross, diagonalise
from pugeo_model.geometry.quadric import QUADRIC, solve, tilt
from pugeo_model.kernel_compiler import njit

__all__ = [
    "FIT",
    "FOOT",
    "HEIGHT",
    "KEPT",
    "SPREAD_1",
    "SPREAD_2",
    "THICKNESS",
    "fit_robust_quadric",
]

FIT = 11
"""Number of results of a fit: the unit normal at the foot of the place (3), then the following."""
FOOT = 3
"""Index of the foot of the place on the quadric (3)."""
THICKNESS = 6
"""Index of the standard deviation of the residuals."""
SPREAD_1 = 7
"""Index of the standard deviation along the first principal axis."""
SPREAD_2 = 8
"""Index of the standard deviation along the second principal axis."""
HEIGHT = 9
"""Index of the signed height of the place above the quadric, along the normal."""
KEPT = 10
"""Index of the share of the weights that the robust fit kept, 0..1."""

_TUKEY = 4.5  # standard deviations from which on a residual has no influence
_TUKEY_KNOWN = 3.2  # the same if the noise is known: a thin wall is told apart from noise
_BANDWIDTH = 0.7  # standard deviations of noise: kernel of the search for the nearest sheet
_SHIFTS = 12  # steps of that search
_RIDGE = 1e-3
_TINY = 1e-300


@njit(cache=True, nogil=True)
def fit_robust_quadric(local, rounds, noise, axes, work, weights, heights, ball, out):  # type: ignore[no-untyped-def]  # noqa: PLR0912, PLR0915
    """Fit a quadric to the points around a place.

    Lengths are in radii of the ball. If the noise is known, the fit starts from the sheet of points
    that is nearest to the place: mean shift of the heights (Comaniciu and Meer 2002) separates
    sheets that are more than some three standard deviations apart.

    Args:
        local: ``(3, n)`` float64 offsets of the points from the place; overwritten.
        rounds: number of robust repetitions, 0 for a plain fit.
        noise: standard deviation of the noise; 0 if it is unknown.
        axes: ``(3, 3)``, receives the frame of the quadric, normal last.
        work: ``(8, 6)``, overwritten.
        weights, heights, ball: ``(n,)``, overwritten.
        out: ``(FIT,)``, receives the results.
    """
    n = local.shape[1]
    matrix, vectors = work[:3, :3], work[3:6, :3]
    total, x, y, z = ball_covariance(local, ball, matrix)
    diagonalise(matrix, vectors)
    first = third = 0
    for a in range(1, 3):
        if matrix[a, a] > matrix[first, first]:
            first = a
        if matrix[a, a] <= matrix[third, third]:
            third = a
    second = 3 - first - third if first != third else (first + 1) % 3
    out[SPREAD_1] = np.sqrt(max(matrix[first, first], 0.0))
    out[SPREAD_2] = np.sqrt(max(matrix[second, second], 0.0))
    for a in range(3):
        axes[0, a], axes[1, a] = vectors[a, first], vectors[a, second]
    cross(axes, 0, 1, 2)
    for j in range(n):
        local[0, j] -= x
        local[1, j] -= y
        local[2, j] -= z
        weights[j] = ball[j]
    gram, q = work[:6, :], work[6, :]
    thickness = kept = 0.0
    for turn in range(rounds + 1):
        mass = _gram(local, weights, axes, gram, q)
        if mass <= _TINY:
            break
        _regularise(gram, mass)
        solve(gram, q)
        if turn < rounds or rounds == 0:
            # Heights are measured along the normal, so the frame is tilted to it first.
            tilt(axes, q)
            _gram(local, weights, axes, gram, q)
            _regularise(gram, mass)
            solve(gram, q)
        _residuals(local, axes, q, heights)
        squares = spread = count = 0.0
        for j in range(n):
            w = weights[j]
            squares += w * heights[j] * heights[j]
            spread += w * w
            count += w
        # Degrees of freedom: uneven weights stand for fewer points, and six are fitted.
        several = count * count / max(spread, _TINY)
        variance = squares / max(count, _TINY)
        thickness = np.sqrt(variance * several / max(several - 6.0, 0.5))
        kept = count / total
        if turn == rounds:
            break
        middle, limit = 0.0, _TUKEY * max(thickness, 1e-9)
        if noise > 0.0:
            limit = min(limit, _TUKEY_KNOWN * noise)
            if turn == 0:
                middle = _nearest_sheet(heights, ball, _height(axes, q, x, y, z), noise)
        for j in range(n):
            r = (heights[j] - middle) / limit
            r = 1.0 - r * r
            weights[j] = ball[j] * r * r if r > 0.0 else 0.0
    _foot(axes, q, x, y, z, out)
    out[THICKNESS], out[KEPT] = thickness, kept


@njit(cache=True, nogil=True)
def _nearest_sheet(heights, ball, start, noise):  # type: ignore[no-untyped-def]
    """Mode of the heights that mean shift reaches from ``start``."""
    scale = 0.5 / (_BANDWIDTH * noise) ** 2
    mode = start
    for _ in range(_SHIFTS):
        total = mass = 0.0
        for j in range(len(heights)):
            apart = heights[j] - mode
            w = ball[j] * np.exp(-scale * apart * apart)
            total += w * heights[j]
            mass += w
        if mass <= _TINY:
            return start
        mode = total / mass
    return mode


@njit(cache=True, nogil=True)
def _height(axes, q, x, y, z):  # type: ignore[no-untyped-def]
    """Height of the place, which is at minus the mean, above the quadric."""
    u = -(axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z)
    v = -(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z)
    h = -(axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z)
    return h - (q[0] + q[1] * u + q[2] * v + q[3] * u * u + q[4] * u * v + q[5] * v * v)


@njit(cache=True, nogil=True)
def _foot(axes, q, x, y, z, out):  # type: ignore[no-untyped-def]
    """Normal, foot and height of the place: one Newton step towards the quadric."""
    u = -(axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z)
    v = -(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z)
    du, dv = q[1] + 2.0 * q[3] * u + q[4] * v, q[2] + q[4] * u + 2.0 * q[5] * v
    over = _height(axes, q, x, y, z)
    inverse = 1.0 / np.sqrt(1.0 + du * du + dv * dv)
    for a in range(3):
        normal = (axes[2, a] - du * axes[0, a] - dv * axes[1, a]) * inverse
        out[a] = normal
        out[FOOT + a] = -over * inverse * normal
    out[HEIGHT] = over * inverse


@njit(cache=True, nogil=True)
def _regularise(gram, mass):  # type: ignore[no-untyped-def]
    for a in range(QUADRIC):
        gram[a, a] += _RIDGE * mass * (1.0 if a < 3 else 0.3)


@njit(cache=True, nogil=True, fastmath=True)
def _residuals(local, axes, q, out):  # type: ignore[no-untyped-def]
    for j in range(local.shape[1]):
        x, y, z = local[0, j], local[1, j], local[2, j]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        h = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        out[j] = h - (q[0] + q[1] * u + q[2] * v + q[3] * u * u + q[4] * u * v + q[5] * v * v)


@njit(cache=True, nogil=True, fastmath=True)
def _gram(local, weights, axes, gram, right):  # type: ignore[no-untyped-def]
    """Set up the normal equations of the fit; returns the sum of the weights."""
    gram[:] = 0.0
    right[:] = 0.0
    for j in range(local.shape[1]):
        w = weights[j]
        if w == 0.0:
            continue
        x, y, z = local[0, j], local[1, j], local[2, j]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
        h = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        b1, b2, b3, b4, b5 = u, v, u * u, u * v, v * v
        wu, wv = w * u, w * v
        wuu, wuv, wvv = w * b3, w * b4, w * b5
        gram[0, 0] += w
        gram[1, 0] += wu
        gram[1, 1] += wuu
        gram[2, 0] += wv
        gram[2, 1] += wuv
        gram[2, 2] += wvv
        gram[3, 3] += wuu * b3
        gram[4, 3] += wuu * b4
        gram[4, 4] += wuv * b4
        gram[5, 4] += wuv * b5
        gram[5, 5] += wvv * b5
        gram[3, 1] += wuu * b1
        gram[3, 2] += wuu * b2
        gram[5, 1] += wvv * b1
        gram[5, 2] += wvv * b2
        right[0] += w * h
        right[1] += wu * h
        right[2] += wv * h
        right[3] += wuu * h
        right[4] += wuv * h
        right[5] += wvv * h
    gram[3, 0], gram[4, 0], gram[5, 0] = gram[1, 1], gram[2, 1], gram[2, 2]
    gram[4, 1], gram[4, 2] = gram[3, 2], gram[5, 1]
    gram[5, 3] = gram[4, 4]
    return gram[0, 0]
