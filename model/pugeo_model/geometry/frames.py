# SPDX-License-Identifier: Apache-2.0
"""Canonical frames: every neighbourhood turned, scaled and bent to look alike.

A frame has rows ``t1, t2, n``. It starts from a Gaussian-weighted PCA, then is tilted twice by the
slope of a quadric (jet) fitted to the neighbours' heights, the second time with a support that
widens with the noise the first fit met. Rotation, scale and density are gone before the network
starts, so no augmentation has to teach them. Lengths in a frame are in units of the local spacing.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["QUADRIC", "Frames", "fit_frames", "flip_frames", "noise_level", "rough_residuals"]

QUADRIC = 6
"""Coefficients ``h(u, v) = c0 + c1 u + c2 v + c3 u^2/2 + c4 u v + c5 v^2/2``."""

_SUPPORT = 1.6  # Gaussian support of the fit in spacings, on clean input
_WIDEST = 3.0  # on the noisiest: 32 neighbours reach no further
_NOISE_GAIN = 6.0  # spacings of support per spacing of height residual
_NOTHING = 30.0  # exponent beyond which a weight is none
_NOISE_QUANTILE = 0.1
_CLEAN = 0.06  # residual, in spacings, that curvature alone leaves on clean input


@dataclass(frozen=True, eq=False)
class Frames:
    """One frame a point.

    Attributes:
        axes: ``(M, 3, 3)`` float32 rotation, rows ``t1, t2, n`` in the world frame.
        spacing: ``(M,)`` float32, the points' units.
        quadric: ``(M, 6)`` float32, in the frame, lengths in spacings.
        residual: ``(M,)`` float32, weighted RMS height above the quadric, in spacings.
        noise: of the whole cloud, in spacings, see `noise_level`.
    """

    axes: NDArray[np.float32]
    spacing: NDArray[np.float32]
    quadric: NDArray[np.float32]
    residual: NDArray[np.float32]
    noise: float


def fit_frames(
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    spacing: NDArray[np.float32],
    noise: float | None = None,
) -> Frames:
    """Frames of all points.

    Args:
        points: ``(M, 3)`` float64.
        neighbours: ``(M, k)`` int32, nearest first.
        spacing: ``(M,)`` float32.
        noise: the cloud's, where it is known already; measured otherwise.
    """
    axes, quadric, residual = _rough_frames(points, neighbours, spacing)
    if noise is None:
        noise = noise_level(residual)
    support = min(_SUPPORT + _NOISE_GAIN * max(noise - _CLEAN, 0.0), _WIDEST)
    _fine(points, neighbours, spacing, support, axes, quadric, residual)
    return Frames(
        axes.astype(np.float32),
        spacing,
        quadric.astype(np.float32),
        residual.astype(np.float32),
        noise,
    )


def rough_residuals(
    points: NDArray[np.float64], neighbours: NDArray[np.int32], spacing: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Residuals ``(m,)``, in spacings, of the ``m`` leading points: what `noise_level` goes by.

    Args:
        points: ``(M, 3)`` float64.
        neighbours: ``(m, k)`` int32 rows of ``points``.
        spacing: ``(m,)`` float32.
    """
    return _rough_frames(points, neighbours, spacing)[2]


def _rough_frames(
    points: NDArray[np.float64], neighbours: NDArray[np.int32], spacing: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    count = len(neighbours)
    axes, quadric, residual = (np.zeros((count, *s)) for s in ((3, 3), (QUADRIC,), ()))
    _rough(points, neighbours, spacing, axes, quadric, residual)
    return axes, quadric, residual


def noise_level(residual: NDArray[Any]) -> float:
    """The noise of a cloud, in spacings, from its residuals ``(M,)``.

    Detail leaves residuals here and there, noise everywhere: so it is what nine in ten exceed.
    """
    return float(np.quantile(residual, _NOISE_QUANTILE))


def flip_frames(frames: Frames, normal: NDArray[np.bool_], tangent: NDArray[np.bool_]) -> Frames:
    """Turn chosen frames over, as training does: signs of PCA axes are never certain.

    Args:
        frames: the frames of ``M`` points.
        normal: ``(M,)`` where ``n`` is negated (and ``t2``, to stay right-handed).
        tangent: ``(M,)`` where ``t1`` is negated (and ``t2``).
    """
    n = np.where(normal, -1.0, 1.0).astype(np.float32)
    t = np.where(tangent, -1.0, 1.0).astype(np.float32)
    axes = frames.axes * np.stack([t, n * t, n], axis=1)[:, :, None]
    u, v, h = t, n * t, n
    signs = np.stack([h, h * u, h * v, h, h * u * v, h], axis=1)
    return Frames(axes, frames.spacing, frames.quadric * signs, frames.residual, frames.noise)


@njit(cache=True, nogil=True)
def _rough(points, neighbours, spacing, axes, quadric, residual):  # type: ignore[no-untyped-def]
    """Principal axes, and the first tilt."""
    local, weights = np.empty((3, neighbours.shape[1])), np.empty(neighbours.shape[1])
    system = np.zeros((QUADRIC, QUADRIC))
    for i in range(len(neighbours)):
        _look(points, neighbours[i], spacing, i, local)
        _weigh(local, _SUPPORT, weights)
        _principal_axes(local, weights, axes[i], system)
        residual[i] = _fit(local, weights, axes[i], system, quadric[i])
        _tilt(axes[i], quadric[i])


@njit(cache=True, nogil=True)
def _fine(points, neighbours, spacing, support, axes, quadric, residual):  # type: ignore[no-untyped-def]
    """The second tilt, signs, and the fit that stays."""
    k = neighbours.shape[1]
    local, weights, near = np.empty((3, k)), np.empty(k), np.empty(k)
    system = np.zeros((QUADRIC, QUADRIC))
    for i in range(len(neighbours)):
        _look(points, neighbours[i], spacing, i, local)
        _weigh(local, _SUPPORT, near)
        _weigh(local, support, weights)
        _fit(local, weights, axes[i], system, quadric[i])
        _tilt(axes[i], quadric[i])
        _fix_signs(local, near, axes[i])
        residual[i] = _fit(local, weights, axes[i], system, quadric[i])


@njit(cache=True, nogil=True)
def _look(points, neighbours, spacing, i, local):  # type: ignore[no-untyped-def]
    """Neighbours as seen from a point, in spacings: ``(3, k)``, for loops along neighbours."""
    scale = 1.0 / spacing[i]
    for j in range(len(neighbours)):
        other = neighbours[j]
        local[0, j] = (points[other, 0] - points[i, 0]) * scale
        local[1, j] = (points[other, 1] - points[i, 1]) * scale
        local[2, j] = (points[other, 2] - points[i, 2]) * scale


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(local, support, weights):  # type: ignore[no-untyped-def]
    """Gaussian weights of the neighbours, by distance alone: turning a frame leaves them be.

    ``exp(-x)`` as the 64th power of the series of ``exp(-x / 64)``, right to 1e-9: the library's
    function is called for one number at a time, this is a loop for eight.
    """
    inverse = 1.0 / (support * support)
    for j in range(local.shape[1]):
        x = (local[0, j] ** 2 + local[1, j] ** 2 + local[2, j] ** 2) * inverse
        z = 1.0 - x / 256.0 * (1.0 - x / 320.0 * (1.0 - x / 384.0))
        z = 1.0 - x / 64.0 * (1.0 - x / 128.0 * (1.0 - x / 192.0 * z))
        z *= z
        z *= z
        z *= z
        z *= z
        z *= z
        z *= z
        weights[j] = z if x < _NOTHING else 0.0


@njit(cache=True, nogil=True, fastmath=True)
def _second_moments(local, weights):  # type: ignore[no-untyped-def]
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
def _principal_axes(local, weights, rows, work):  # type: ignore[no-untyped-def]
    """``rows`` get the directions of falling variance of the Gaussian-weighted neighbours."""
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
    _diagonalise(matrix, vectors)
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
    _cross(rows, 0, 1, 2)


@njit(cache=True, nogil=True)
def _cross(rows, a, b, to):  # type: ignore[no-untyped-def]
    x = rows[a, 1] * rows[b, 2] - rows[a, 2] * rows[b, 1]
    y = rows[a, 2] * rows[b, 0] - rows[a, 0] * rows[b, 2]
    z = rows[a, 0] * rows[b, 1] - rows[a, 1] * rows[b, 0]
    rows[to, 0], rows[to, 1], rows[to, 2] = x, y, z


@njit(cache=True, nogil=True)
def _diagonalise(matrix, vectors):  # type: ignore[no-untyped-def]
    """Jacobi rotations of a symmetric 3x3, in place; columns of ``vectors`` are eigenvectors."""
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


@njit(cache=True, nogil=True)
def _solve(matrix, right):  # type: ignore[no-untyped-def]
    """Cholesky solution of a symmetric positive definite system, in place in ``right``."""
    for i in range(QUADRIC):
        for j in range(i + 1):
            total = matrix[i, j]
            for m in range(j):
                total -= matrix[i, m] * matrix[j, m]
            # The diagonal keeps inverses: a division is worth ten products.
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


@njit(cache=True, nogil=True, fastmath=True)
def _gram(local, weights, axes, gram, right):  # type: ignore[no-untyped-def]
    """The normal equations of the fit; returns the sum of weights and of squared heights.

    Every sum is a name of its own, so that all stay in registers.
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
def _fit(local, weights, axes, gram, coefficients):  # type: ignore[no-untyped-def]
    """Ridge fit of the quadric in the frame ``axes``; returns the weighted RMS residual."""
    total, squares = _gram(local, weights, axes, gram, coefficients)
    e0, e1, e2 = coefficients[0], coefficients[1], coefficients[2]
    e3, e4, e5 = coefficients[3], coefficients[4], coefficients[5]
    for a in range(QUADRIC):
        gram[a, a] += 0.02 * total / 8.0
    _solve(gram, coefficients)
    squares -= e0 * coefficients[0] + e1 * coefficients[1] + e2 * coefficients[2]
    squares -= e3 * coefficients[3] + e4 * coefficients[4] + e5 * coefficients[5]
    return np.sqrt(max(squares, 0.0) / total)


@njit(cache=True, nogil=True)
def _tilt(frame, quadric):  # type: ignore[no-untyped-def]
    """Turn the normal of a frame to that of the fitted quadric at the point."""
    length = 1.0 / np.sqrt(1.0 + quadric[1] * quadric[1] + quadric[2] * quadric[2])
    along = 0.0
    for a in range(3):
        frame[2, a] = (frame[2, a] - quadric[1] * frame[0, a] - quadric[2] * frame[1, a]) * length
        along += frame[0, a] * frame[2, a]
    squared = 0.0
    for a in range(3):
        frame[0, a] -= along * frame[2, a]
        squared += frame[0, a] * frame[0, a]
    for a in range(3):
        frame[0, a] /= np.sqrt(squared)
    _cross(frame, 2, 0, 1)


@njit(cache=True, nogil=True, fastmath=True)
def _asymmetry(local, weights, frame):  # type: ignore[no-untyped-def]
    """Mean height of the neighbours, and skew along the first axis, up to positive factors."""
    height = skew = 0.0
    for j in range(len(weights)):
        x, y, z, w = local[0, j], local[1, j], local[2, j], weights[j]
        u = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z
        height += w * (frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z)
        skew += w * u * u * u
    return height, skew


@njit(cache=True, nogil=True)
def _fix_signs(local, weights, frame):  # type: ignore[no-untyped-def]
    """Normal towards the heavier side, first axis towards the longer tail, right-handed."""
    height, skew = _asymmetry(local, weights, frame)
    up = -1.0 if height < 0.0 else 1.0
    along = -1.0 if skew < 0.0 else 1.0
    for a in range(3):
        frame[0, a] *= along
        frame[1, a] *= up * along
        frame[2, a] *= up
