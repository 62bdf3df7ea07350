# SPDX-License-Identifier: Apache-2.0
"""Signs of normals relative to each other: neighbours agree, along a minimum spanning tree."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["dots", "join", "relative_signs"]

# Edges below this share of the local mean length are mistrusted. Found on the training meshes with
# noise of 0 to 1 % of their size: 94 % of the signs come out right; 88 % without it, and 69 % with
# plain dot products.
_SHORT = 0.6


def relative_signs(
    points: NDArray[Any], normals: NDArray[Any], neighbours: NDArray[np.integer[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Make neighbours agree.

    Args:
        points: ``(M, 3)`` float64, near the origin.
        normals: ``(M, 3)`` float, unit length, of any sign.
        neighbours: ``(M, k)`` rows near each point; others than ``0..M-1`` are skipped.

    Returns:
        Signs -1 or 1 ``(M,)``, consistent within each connected part, and the part ``(M,)`` of
        each point, numbered from 0.
    """
    count, width = neighbours.shape
    weights = np.empty((count, width), dtype=np.float32)
    opposite = np.empty((count, width), dtype=np.bool_)
    _compare(points, normals, neighbours, weights, opposite)
    here = np.repeat(np.arange(count, dtype=np.int32), width)
    return join(count, here, neighbours.ravel(), weights.ravel(), opposite.ravel())


def join(
    count: int,
    left: NDArray[np.integer[Any]],
    right: NDArray[np.integer[Any]],
    weights: NDArray[np.float32],
    opposite: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Signs of nodes along the lightest edges that join them (Kruskal's algorithm).

    Args:
        count: number of nodes.
        left: ``(E,)`` node at one end of each edge.
        right: ``(E,)`` at the other; edges to itself, or to numbers outside ``0..count-1``, are
            skipped.
        weights: ``(E,)``, none negative.
        opposite: ``(E,)`` whether the signs of the two ends differ.

    Returns:
        Signs -1 or 1 ``(count,)``, that of the first node of each connected part 1, and the part
        ``(count,)`` of each node, numbered from 0.
    """
    signs, parts = np.empty(count), np.empty(count, dtype=np.intp)
    _join(_by_weight(weights.view(np.uint32)), left, right, opposite, signs, parts)
    return signs, parts


def dots(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Products of rows, ``(N,)``."""
    products: NDArray[Any] = np.einsum("ij,ij->i", left, right)
    return products


@njit(cache=True, nogil=True)
def _compare(
    points: NDArray[Any],
    normals: NDArray[Any],
    neighbours: NDArray[Any],
    weights: NDArray[Any],
    opposite: NDArray[Any],
) -> None:
    """Weights of the edges, infinite where there is none, and whether normals disagree there.

    The left normal is reflected in the plane midway between both points before it is compared,
    which on a circle gives the right normal exactly. Plain dot products would orient both sides
    of a thin wall the same way.
    """
    count, width = neighbours.shape
    lengths = np.empty(width)
    for i in range(count):
        total, degree = 0.0, 0
        for k in range(width):
            j = neighbours[i, k]
            lengths[k] = -1.0
            if 0 <= j < count and j != i:
                squared = 0.0
                for a in range(3):
                    squared += (points[j, a] - points[i, a]) ** 2
                lengths[k] = np.sqrt(squared)
                total += lengths[k]
                degree += 1
        short = _SHORT * total / max(degree, 1)
        for k in range(width):
            j = neighbours[i, k]
            if lengths[k] < 0.0:
                weights[i, k], opposite[i, k] = np.inf, False
                continue
            inverse = 1.0 / lengths[k] if lengths[k] > 0.0 else 1.0
            left = right = cosine = 0.0
            for a in range(3):
                edge = (points[j, a] - points[i, a]) * inverse
                left += normals[i, a] * edge
                right += normals[j, a] * edge
                cosine += normals[i, a] * normals[j, a]
            cosine -= 2.0 * left * right
            # Two points that noise has put above each other look like the two sides of a wall.
            # Such edges are short; the edges that go around a sharp rim are of common length.
            shortness = min((short * inverse) ** 4, 1.0) if lengths[k] > 0.0 else 1.0
            steepness = max(left * left, right * right)
            weights[i, k] = max(1.0 - abs(cosine) + steepness * shortness, 0.0)
            opposite[i, k] = cosine < 0.0


@njit(cache=True, nogil=True)
def _by_weight(bits: NDArray[np.uint32]) -> NDArray[np.int32]:
    """Stable order of float32 numbers, none negative, by their bits, eleven at a time."""
    order = np.arange(len(bits)).astype(np.int32)
    other = np.empty_like(order)
    for shift in (0, 11, 22):
        start = np.zeros(2049, dtype=np.int64)
        for value in bits:
            start[((value >> shift) & 2047) + 1] += 1
        for digit in range(2048):
            start[digit + 1] += start[digit]
        for at in order:
            digit = (bits[at] >> shift) & 2047
            other[start[digit]] = at
            start[digit] += 1
        order, other = other, order
    return order


@njit(cache=True, nogil=True)
def _root(parent: NDArray[Any], flipped: NDArray[Any], row: int) -> tuple[int, bool]:
    """Root of a row's part and whether the row's sign differs from it; shortens the way there."""
    flip = False
    while parent[row] != row:
        above = parent[row]
        flipped[row] ^= flipped[above]
        parent[row] = parent[above]
        flip ^= flipped[row]
        row = parent[row]
    return row, flip


@njit(cache=True, nogil=True)
def _join(
    order: NDArray[Any],
    left: NDArray[Any],
    right: NDArray[Any],
    opposite: NDArray[Any],
    signs: NDArray[Any],
    parts: NDArray[Any],
) -> None:
    """Join parts along edges in their order."""
    count = len(signs)
    parent, flipped = np.arange(count), np.zeros(count, dtype=np.bool_)
    apart = count - 1
    for edge in order:
        i, j = left[edge], right[edge]
        if apart == 0:
            break
        if not 0 <= j < count or j == i:
            continue
        here, mine = _root(parent, flipped, i)
        there, yours = _root(parent, flipped, j)
        if here != there:
            flip = mine ^ yours ^ opposite[edge]
            low, high = min(here, there), max(here, there)
            parent[high] = low
            flipped[high] = flip
            apart -= 1
    total = 0
    for i in range(count):
        root, flip = _root(parent, flipped, i)
        signs[i] = -1.0 if flip else 1.0
        # The root is the lowest row of its part, so it has come already.
        if root == i:
            parts[i] = total
            total += 1
        else:
            parts[i] = parts[root]
