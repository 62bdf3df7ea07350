# SPDX-License-Identifier: Apache-2.0
"""Canonical frames: every neighbourhood turned, scaled and bent to look alike.

A frame has rows ``t1, t2, n``. It starts from a Gaussian-weighted PCA, then is tilted twice by the
slope of a quadric (jet) fitted to the neighbours' heights, the second time with a support that
widens with the noise the first fit met. Rotation, scale and density are gone before the network
starts, so no augmentation has to teach them. Lengths in a frame are in units of the local spacing.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["QUADRIC", "Frames", "fit_frames", "flip_frames"]

QUADRIC = 6
"""Coefficients ``h(u, v) = c0 + c1 u + c2 v + c3 u^2/2 + c4 u v + c5 v^2/2``."""

_SUPPORT = 1.6  # Gaussian support of the fit in spacings, on clean input
_WIDEST = 3.0  # on the noisiest: 32 neighbours reach no further
_NOISE_GAIN = 6.0  # spacings of support per spacing of height residual
_CLEAN = 0.06  # residual, in spacings, that curvature alone leaves on clean input


@dataclass(frozen=True, eq=False)
class Frames:
    """One frame a point.

    Attributes:
        axes: ``(M, 3, 3)`` float32 rotation, rows ``t1, t2, n`` in the world frame.
        spacing: ``(M,)`` float32, the points' units.
        quadric: ``(M, 6)`` float32, in the frame, lengths in spacings.
        residual: ``(M,)`` float32, weighted RMS height above the quadric, in spacings.
        noise: the median residual of the whole cloud, in spacings.
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
        noise: the cloud's median residual where it is known already; measured otherwise.
    """
    count = len(points)
    axes = np.zeros((count, 3, 3))
    quadric = np.zeros((count, QUADRIC))
    residual = np.zeros(count)
    _principal_axes(points, neighbours, spacing, axes)
    _tilt(points, neighbours, spacing, _SUPPORT, axes, quadric, residual)
    if noise is None:
        noise = float(np.median(residual))
    support = min(_SUPPORT + _NOISE_GAIN * max(noise - _CLEAN, 0.0), _WIDEST)
    _tilt(points, neighbours, spacing, support, axes, quadric, residual)
    _fix_signs(points, neighbours, spacing, axes)
    _fit(points, neighbours, spacing, support, axes, quadric, residual)
    return Frames(
        axes.astype(np.float32),
        spacing,
        quadric.astype(np.float32),
        residual.astype(np.float32),
        noise,
    )


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
def _principal_axes(points, neighbours, spacing, axes):  # type: ignore[no-untyped-def]
    """Rows of ``axes``: directions of falling variance of the Gaussian-weighted neighbours."""
    count, k = neighbours.shape
    mean = np.zeros(3)
    second = np.zeros((3, 3))
    d = np.zeros(3)
    for i in range(count):
        total = 1.0
        mean[:] = 0.0
        second[:] = 0.0
        for j in range(k):
            far = 0.0
            for a in range(3):
                d[a] = (points[neighbours[i, j], a] - points[i, a]) / spacing[i]
                far += d[a] * d[a]
            w = np.exp(-far / (_SUPPORT * _SUPPORT))
            total += w
            for a in range(3):
                mean[a] += w * d[a]
                for b in range(a + 1):
                    second[a, b] += w * d[a] * d[b]
        for a in range(3):
            for b in range(a + 1):
                second[a, b] -= mean[a] * mean[b] / total
                second[b, a] = second[a, b]
        _eigenvectors(second, axes[i])


@njit(cache=True, nogil=True)
def _eigenvectors(matrix, rows):  # type: ignore[no-untyped-def]
    """Jacobi rotations of a symmetric 3x3; ``rows`` gets the eigenvectors, largest first."""
    vectors = np.eye(3)
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
    order = np.argsort(-np.diag(matrix))
    for a in range(2):
        for r in range(3):
            rows[a, r] = vectors[r, order[a]]
    rows[2] = np.cross(rows[0], rows[1])


@njit(cache=True, nogil=True)
def _solve(normal_matrix, right):  # type: ignore[no-untyped-def]
    """Cholesky solution of a small symmetric positive definite system, in place in ``right``."""
    n = len(right)
    for i in range(n):
        for j in range(i + 1):
            total = normal_matrix[i, j]
            for m in range(j):
                total -= normal_matrix[i, m] * normal_matrix[j, m]
            if i == j:
                normal_matrix[i, i] = np.sqrt(max(total, 1e-12))
            else:
                normal_matrix[i, j] = total / normal_matrix[j, j]
    for i in range(n):
        total = right[i]
        for m in range(i):
            total -= normal_matrix[i, m] * right[m]
        right[i] = total / normal_matrix[i, i]
    for i in range(n - 1, -1, -1):
        total = right[i]
        for m in range(i + 1, n):
            total -= normal_matrix[m, i] * right[m]
        right[i] = total / normal_matrix[i, i]


@njit(cache=True, nogil=True)
def _fit_one(points, neighbours, spacing, support, i, axes, gram, row, coefficients):  # type: ignore[no-untyped-def]
    """Ridge fit of the quadric in the frame ``axes``; returns the weighted RMS residual."""
    k = neighbours.shape[1]
    gram[:] = 0.0
    coefficients[:] = 0.0
    squares = 0.0
    total = 0.0
    for j in range(-1, k):
        u = v = h = 0.0
        if j >= 0:
            other = neighbours[i, j]
            x = (points[other, 0] - points[i, 0]) / spacing[i]
            y = (points[other, 1] - points[i, 1]) / spacing[i]
            z = (points[other, 2] - points[i, 2]) / spacing[i]
            u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            h = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        w = np.exp(-(u * u + v * v + h * h) / (support * support))
        row[0] = 1.0
        row[1] = u
        row[2] = v
        row[3] = 0.5 * u * u
        row[4] = u * v
        row[5] = 0.5 * v * v
        for a in range(QUADRIC):
            for b in range(a + 1):
                gram[a, b] += w * row[a] * row[b]
            coefficients[a] += w * row[a] * h
        squares += w * h * h
        total += w
    for a in range(QUADRIC):
        gram[a, a] += 0.02 * total / 8.0
    explained = coefficients.copy()
    _solve(gram, coefficients)
    for a in range(QUADRIC):
        squares -= explained[a] * coefficients[a]
    return np.sqrt(max(squares, 0.0) / total)


@njit(cache=True, nogil=True)
def _fit(points, neighbours, spacing, support, axes, quadric, residual):  # type: ignore[no-untyped-def]
    gram = np.zeros((QUADRIC, QUADRIC))
    row = np.zeros(QUADRIC)
    for i in range(len(neighbours)):
        residual[i] = _fit_one(
            points, neighbours, spacing, support, i, axes[i], gram, row, quadric[i]
        )


@njit(cache=True, nogil=True)
def _tilt(points, neighbours, spacing, support, axes, quadric, residual):  # type: ignore[no-untyped-def]
    """Fit, then turn the normal of every frame to that of the fitted quadric at the point."""
    gram = np.zeros((QUADRIC, QUADRIC))
    row = np.zeros(QUADRIC)
    for i in range(len(neighbours)):
        frame = axes[i]
        residual[i] = _fit_one(
            points, neighbours, spacing, support, i, frame, gram, row, quadric[i]
        )
        normal = frame[2] - quadric[i, 1] * frame[0] - quadric[i, 2] * frame[1]
        normal /= np.sqrt((normal * normal).sum())
        first = frame[0] - (frame[0] * normal).sum() * normal
        first /= np.sqrt((first * first).sum())
        frame[2] = normal
        frame[0] = first
        frame[1] = np.cross(normal, first)


@njit(cache=True, nogil=True)
def _fix_signs(points, neighbours, spacing, axes):  # type: ignore[no-untyped-def]
    """Normal towards the heavier side, first axis towards the longer tail, right-handed."""
    count, k = neighbours.shape
    for i in range(count):
        frame = axes[i]
        height = 0.0
        skew = 0.0
        for j in range(k):
            far = u = h = 0.0
            for a in range(3):
                d = (points[neighbours[i, j], a] - points[i, a]) / spacing[i]
                far += d * d
                u += frame[0, a] * d
                h += frame[2, a] * d
            w = np.exp(-far / (_SUPPORT * _SUPPORT))
            height += w * h
            skew += w * u * u * u
        up = -1.0 if height < 0.0 else 1.0
        along = -1.0 if skew < 0.0 else 1.0
        for a in range(3):
            frame[0, a] *= along
            frame[1, a] *= up * along
            frame[2, a] *= up
