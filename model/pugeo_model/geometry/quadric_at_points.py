# SPDX-License-Identifier: Apache-2.0
"""Fits of quadrics to the nearest points of each point: noise, flatness and order of a scan."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.areas import neighbour_mean
from pugeo_model.geometry.neighbours import SPACING_NEIGHBOURS
from pugeo_model.geometry.neighbours import spacing as mean_spacing
from pugeo_model.geometry.robust_quadric import (
    FIT,
    FOOT,
    SPREAD_1,
    SPREAD_2,
    THICKNESS,
    fit_robust_quadric,
)
from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = [
    "QuadricsAtPoints",
    "are_stacked",
    "heights_over_neighbours",
    "is_stacked",
    "quadrics_at",
    "ranked_neighbour",
]

_NEAREST = 24  # points of a fit
_BLOCK = 1 << 16  # points at a time, which bounds memory


@dataclass(frozen=True, eq=False)
class QuadricsAtPoints:
    """Properties of the nearest points of each point.

    Attributes:
        spacing: ``(n,)`` float64 mean distance to the 8 nearest.
        thickness: ``(n,)`` standard deviation from a quadric, in spacings.
        flatness: ``(n,)`` second principal spread over the first: 0 on a line, 1 on a disc.
        normal: ``(n, 3)`` of the quadric, of any sign.
        direction: ``(n, 3)`` unit vector to the nearest point.
        order: ``(n,)`` of the nearest: 1 on a square or hexagonal lattice, 0 on a line.
    """

    spacing: NDArray[np.float64]
    thickness: NDArray[np.float64]
    flatness: NDArray[np.float64]
    normal: NDArray[np.float64]
    direction: NDArray[np.float64]
    order: NDArray[np.float64]


def quadrics_at(
    rows: NDArray[np.intp],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    distances: NDArray[np.float32],
) -> QuadricsAtPoints:
    """Fit a quadric to the nearest points of some points.

    Args:
        rows: ``(n,)`` rows of the points.
        points: ``(M, 3)``.
        neighbours, distances: ``(n, k)`` of the nearest, in order.
    """
    spacing = np.maximum(mean_spacing(distances).astype(np.float64), 1e-12)
    thickness, flatness, normal, order = _fit_at(rows, points, neighbours, distances)
    direction = points[neighbours[:, 0]] - points[rows]
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
    return QuadricsAtPoints(spacing, thickness, flatness, normal, direction, order)


def are_stacked(near: QuadricsAtPoints, neighbours: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which points belong to stacked frames, ``(M,)``.

    The nearest points of stacked frames lie in one direction, that of the rays, and not along the
    surface.

    Args:
        near: of all points.
        neighbours: ``(M, k)`` rows.
    """
    rows, columns = np.triu_indices(3)
    means = [
        neighbour_mean(near.direction[:, row] * near.direction[:, column], neighbours, 1)
        for row, column in zip(rows, columns, strict=True)
    ]
    order, slope = np.empty(len(neighbours)), np.empty(len(neighbours))
    for start in range(0, len(neighbours), _BLOCK):
        part = slice(start, start + _BLOCK)
        tensor = np.empty((len(order[part]), 3, 3))
        for row, column, mean in zip(rows, columns, means, strict=True):
            tensor[:, row, column] = tensor[:, column, row] = mean[part]
        values, vectors = np.linalg.eigh(tensor)
        order[part] = values[:, 2]
        slope[part] = np.abs(np.einsum("ni,ni->n", vectors[:, :, 2], near.normal[part]))
    typical = ranked_neighbour(slope, neighbours, neighbours.shape[1] // 2)
    stacked: NDArray[np.bool_] = (order > TUNING.stacked_order) & (typical > TUNING.stacked_slope)
    return stacked


def is_stacked(near: QuadricsAtPoints, part: slice) -> bool:
    """Return whether some points next to each other belong to stacked frames."""
    directions = near.direction[part]
    values, vectors = np.linalg.eigh(directions.T @ directions / len(directions))
    slope = np.median(np.abs(near.normal[part] @ vectors[:, 2]))
    return bool(values[2] > TUNING.stacked_order and slope > TUNING.stacked_slope)


@njit(cache=True, nogil=True)
def _fit_at(rows, points, neighbours, distances):  # type: ignore[no-untyped-def]
    count = min(_NEAREST, neighbours.shape[1])
    thickness, flatness, order = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    normal = np.empty((len(rows), 3))
    local = np.empty((3, count + 1))
    axes, work, out = np.zeros((3, 3)), np.zeros((8, 6)), np.empty(FIT)
    weights, heights, ball = np.empty(count + 1), np.empty(count + 1), np.empty(count + 1)
    for i in range(len(rows)):
        own = rows[i]
        radius = 1.3 * max(distances[i, count - 1], 1e-300)
        for j in range(count):
            for a in range(3):
                local[a, j] = (points[neighbours[i, j], a] - points[own, a]) / radius
        local[:, count] = 0.0
        fit_robust_quadric(local, 0, 0.0, axes, work, weights, heights, ball, out)
        spacing = 0.0
        for j in range(SPACING_NEIGHBOURS):
            spacing += distances[i, min(j, count - 1)] / SPACING_NEIGHBOURS
        thickness[i] = out[THICKNESS] * radius / max(spacing, 1e-300)
        flatness[i] = out[SPREAD_2] / max(out[SPREAD_1], 1e-300)
        normal[i, 0], normal[i, 1], normal[i, 2] = out[0], out[1], out[2]
        order[i] = _lattice_order(own, points, neighbours[i, :count], axes)
    return thickness, flatness, normal, order


@njit(cache=True, nogil=True)
def _lattice_order(own, points, near, axes):  # type: ignore[no-untyped-def]
    """Order of the directions to the four nearest, or six if larger, less their twofold order.

    The order of n is the magnitude of the mean of ``exp(n i angle)``, as of bonds in crystals
    (Nelson and Halperin 1979). The nearest are those along the surface, whatever the noise.
    """
    count = len(near)
    u, v, squared = np.empty(count), np.empty(count), np.empty(count)
    for j in range(count):
        u[j] = v[j] = 0.0
        for a in range(3):
            step = points[near[j], a] - points[own, a]
            u[j] += axes[0, a] * step
            v[j] += axes[1, a] * step
        squared[j] = max(u[j] * u[j] + v[j] * v[j], 1e-300)
    order = 0.0
    along = across = real = imaginary = real_6 = imaginary_6 = 0.0
    for rank in range(6):
        least = rank
        for j in range(rank + 1, count):
            if squared[j] < squared[least]:
                least = j
        u[rank], u[least] = u[least], u[rank]
        v[rank], v[least] = v[least], v[rank]
        squared[rank], squared[least] = squared[least], squared[rank]
        # The doubled angle, then its double and its triple.
        c = (u[rank] * u[rank] - v[rank] * v[rank]) / squared[rank]
        s = 2.0 * u[rank] * v[rank] / squared[rank]
        along += c
        across += s
        real += c * c - s * s
        imaginary += 2.0 * c * s
        real_6 += c * (c * c - 3.0 * s * s)
        imaginary_6 += s * (3.0 * c * c - s * s)
        if rank == 3:
            fourfold = np.sqrt(real * real + imaginary * imaginary)
            order = 0.25 * (fourfold - np.sqrt(along * along + across * across))
    sixfold = np.sqrt(real_6 * real_6 + imaginary_6 * imaginary_6)
    return max(order, (sixfold - np.sqrt(along * along + across * across)) / 6.0)


@njit(cache=True, nogil=True)
def heights_over_neighbours(rows, points, neighbours):  # type: ignore[no-untyped-def]
    """Heights of points above robust quadrics through their nearest points.

    Args:
        rows: ``(n,)`` rows of the points.
        points: ``(M, 3)``.
        neighbours: ``(n, k)`` of the nearest, in order.

    Returns:
        Heights ``(n,)`` without sign, and standard deviations of the neighbours ``(n,)``, infinite
        if these are on a line.
    """
    count = min(_NEAREST, neighbours.shape[1])
    height, thickness = np.empty(len(rows)), np.empty(len(rows))
    local = np.empty((3, count))
    axes, work, out = np.zeros((3, 3)), np.zeros((8, 6)), np.empty(FIT)
    weights, heights, ball = np.empty(count), np.empty(count), np.empty(count)
    for i in range(len(rows)):
        # The ball stands on the nearest point, so that it contains the foot of the point.
        home = neighbours[i, 0]
        radius = 1e-300
        for j in range(count):
            squared = 0.0
            for a in range(3):
                squared += (points[neighbours[i, j], a] - points[home, a]) ** 2
            radius = max(radius, 1.2 * np.sqrt(squared))
        for j in range(count):
            for a in range(3):
                local[a, j] = (points[neighbours[i, j], a] - points[home, a]) / radius
        fit_robust_quadric(local, 2, 0.0, axes, work, weights, heights, ball, out)
        over = 0.0
        for a in range(3):
            over += out[a] * (points[rows[i], a] - points[home, a] - out[FOOT + a] * radius)
        height[i] = abs(over)
        line = out[SPREAD_2] <= 0.3 * out[SPREAD_1]
        thickness[i] = np.inf if line else out[THICKNESS] * radius
    return height, thickness


def ranked_neighbour(
    values: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    rank: int,
    rows: NDArray[np.intp] | None = None,
) -> NDArray[np.float64]:
    """Return the value of a rank (0 is the least) among each point and its neighbours.

    Args:
        values: ``(M,)`` float64.
        neighbours: ``(M, k)`` rows.
        rank: 0..k.
        rows: ``(n,)`` points whose result is wanted, by default all.

    Returns:
        ``(n,)`` float64.
    """
    rows = np.arange(len(values)) if rows is None else rows
    out = np.empty(len(rows))
    for start in range(0, len(rows), _BLOCK):
        some = slice(start, start + _BLOCK)
        part = rows[some]
        around = np.concatenate([values[part, None], values[neighbours[part]]], axis=1)
        out[some] = np.partition(around, rank, axis=1)[:, rank]
    return out
