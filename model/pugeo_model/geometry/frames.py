# SPDX-License-Identifier: Apache-2.0
"""Canonical frames: local coordinates in which all neighbourhoods look alike.

A frame has rows ``t1, t2, n``. It starts from a Gaussian-weighted PCA and is then tilted twice by
the slope of a quadric fitted to the heights of the neighbours (jet fitting, Cazals and Pouget
2005); the support of the second fit increases with the noise that the first fit measures. The
network thus need not learn rotation, scale or density. Lengths in a frame are in local spacings.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.pca import principal_axes
from pugeo_model.geometry.quadric import QUADRIC, fit_quadric, tilt
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["Frames", "fit_frames", "noise_level", "rough_residuals"]

_SUPPORT = TUNING.fit_support
_WIDEST = TUNING.fit_support_noisy
_NOISE_GAIN = TUNING.fit_support_gain
_LARGEST_EXPONENT = 30.0  # exp(-30) counts as zero


@dataclass(frozen=True, eq=False)
class Frames:
    """One canonical frame per point.

    Attributes:
        axes: ``(M, 3, 3)`` float32 rotations, rows ``t1, t2, n`` in the frame of the cloud.
        spacing: ``(M,)`` float32, in units of the points.
        quadric: ``(M, 6)`` float32 coefficients in the frame, lengths in spacings.
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
    """Fit the canonical frames of all points.

    Args:
        points: ``(M, 3)`` float64.
        neighbours: ``(M, k)`` int32, nearest first.
        spacing: ``(M,)`` float32.
        noise: of the whole cloud, in spacings, if known; otherwise measured from these points.
    """
    axes, quadric, residual = _rough_frames(points, neighbours, spacing)
    if noise is None:
        noise = noise_level(residual)
    support = min(_SUPPORT + _NOISE_GAIN * max(noise - TUNING.clean_residual, 0.0), _WIDEST)
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
    """Return the residuals of the first fit at the ``m`` leading points, for `noise_level`.

    Args:
        points: ``(M, 3)`` float64.
        neighbours: ``(m, k)`` int32 rows of ``points``.
        spacing: ``(m,)`` float32.

    Returns:
        ``(m,)`` float64, in spacings.
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
    """Return the noise level of a cloud, in spacings: a low quantile of its residuals ``(M,)``.

    Detail causes residuals at some points, noise at all points, so a low quantile ignores detail.
    """
    return float(np.quantile(residual, TUNING.noise_quantile))


@njit(cache=True, nogil=True)
def _rough(points, neighbours, spacing, axes, quadric, residual):  # type: ignore[no-untyped-def]
    """Principal axes, first fit and first tilt; writes the last three arguments."""
    local, weights = np.empty((3, neighbours.shape[1])), np.empty(neighbours.shape[1])
    system = np.zeros((QUADRIC, QUADRIC))
    for i in range(len(neighbours)):
        _to_local(points, neighbours[i], spacing, i, local)
        _weigh(local, _SUPPORT, weights)
        principal_axes(local, weights, axes[i], system)
        residual[i] = fit_quadric(local, weights, axes[i], system, quadric[i])
        tilt(axes[i], quadric[i])


@njit(cache=True, nogil=True)
def _fine(points, neighbours, spacing, support, axes, quadric, residual):  # type: ignore[no-untyped-def]
    """Second fit and tilt, signs, and the final fit; updates the last three arguments."""
    k = neighbours.shape[1]
    local, weights, near = np.empty((3, k)), np.empty(k), np.empty(k)
    system = np.zeros((QUADRIC, QUADRIC))
    for i in range(len(neighbours)):
        _to_local(points, neighbours[i], spacing, i, local)
        _weigh(local, _SUPPORT, near)
        _weigh(local, support, weights)
        fit_quadric(local, weights, axes[i], system, quadric[i])
        tilt(axes[i], quadric[i])
        _fix_signs(local, near, axes[i])
        residual[i] = fit_quadric(local, weights, axes[i], system, quadric[i])


@njit(cache=True, nogil=True)
def _to_local(points, neighbours, spacing, i, local):  # type: ignore[no-untyped-def]
    """Offsets of the neighbours from point ``i``, in spacings, into ``local`` ``(3, k)``."""
    scale = 1.0 / spacing[i]
    for j in range(len(neighbours)):
        other = neighbours[j]
        local[0, j] = (points[other, 0] - points[i, 0]) * scale
        local[1, j] = (points[other, 1] - points[i, 1]) * scale
        local[2, j] = (points[other, 2] - points[i, 2]) * scale


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(local, support, weights):  # type: ignore[no-untyped-def]
    """Gaussian weights of the neighbours by distance; a rotation does not change them.

    ``exp(-x)`` is the 64th power of the series of ``exp(-x / 64)``, exact to 1e-9: the compiler
    vectorises this loop, but not calls of ``exp``.
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
        weights[j] = z if x < _LARGEST_EXPONENT else 0.0


@njit(cache=True, nogil=True, fastmath=True)
def _asymmetry(local, weights, frame):  # type: ignore[no-untyped-def]
    """Mean height of the neighbours and skewness along the first axis, up to positive factors."""
    height = skew = 0.0
    for j in range(len(weights)):
        x, y, z, w = local[0, j], local[1, j], local[2, j], weights[j]
        u = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z
        height += w * (frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z)
        skew += w * u * u * u
    return height, skew


@njit(cache=True, nogil=True)
def _fix_signs(local, weights, frame):  # type: ignore[no-untyped-def]
    """Fix the signs: normal towards the mean height, first axis towards the longer tail."""
    height, skew = _asymmetry(local, weights, frame)
    up = -1.0 if height < 0.0 else 1.0
    along = -1.0 if skew < 0.0 else 1.0
    for a in range(3):
        frame[0, a] *= along
        frame[1, a] *= up * along
        frame[2, a] *= up
