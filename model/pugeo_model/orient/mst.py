# SPDX-License-Identifier: Apache-2.0
"""Signs of normals relative to each other: neighbours agree, along a minimum spanning tree."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.tuning import TUNING

__all__ = ["Edges", "relative_signs", "row_dots", "spanning_tree_signs"]

_SHORT = TUNING.short_edge


@dataclass(frozen=True, eq=False)
class Edges:
    """Pairs of points, and how their normals compare.

    Attributes:
        left: ``(E,)`` int32 row at one end.
        right: ``(E,)`` int32 row at the other.
        weights: ``(E,)`` float32 in 0..2, the lighter the surer.
        opposite: ``(E,)`` bool, whether the signs of the two ends differ.
    """

    left: NDArray[np.int32]
    right: NDArray[np.int32]
    weights: NDArray[np.float32]
    opposite: NDArray[np.bool_]

    @classmethod
    def between(
        cls,
        points: NDArray[Any],
        normals: NDArray[Any],
        left: NDArray[np.int32],
        right: NDArray[np.int32],
        short: NDArray[np.float64],
    ) -> "Edges":
        """Compare normals ``(M, 3)`` of points ``(M, 3)`` along edges.

        Args:
            points: float64, near the origin.
            normals: unit length, of any sign.
            left: ``(E,)`` row at one end of each edge.
            right: ``(E,)`` at the other.
            short: ``(M,)`` length below which an edge of that point is mistrusted.
        """
        weights = np.empty(len(left), dtype=np.float32)
        opposite = np.empty(len(left), dtype=np.bool_)
        _compare(points, normals, left, right, short, weights, opposite)
        return cls(left, right, weights, opposite)

    def moved(self, by: int) -> "Edges":
        """The same between points that many rows further on."""
        return replace(self, left=self.left + np.int32(by), right=self.right + np.int32(by))

    @classmethod
    def among(
        cls, points: NDArray[Any], normals: NDArray[Any], neighbours: NDArray[np.integer[Any]]
    ) -> "Edges":
        """Compare neighbours, each pair once.

        Args:
            points: ``(M, 3)`` float64, near the origin.
            normals: ``(M, 3)`` float, unit length, of any sign.
            neighbours: ``(M, k)`` rows near each point; others than ``0..M-1`` are skipped.
        """
        left, right = np.empty((2, neighbours.size), dtype=np.int32)
        short = np.empty(len(points))
        count = _pairs(points, neighbours, left, right, short)
        return cls.between(points, normals, left[:count], right[:count], short)


def relative_signs(
    points: NDArray[Any], normals: NDArray[Any], neighbours: NDArray[np.integer[Any]]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Make neighbours agree; arguments as of `Edges.among`.

    Returns:
        Signs -1 or 1 ``(M,)``, consistent within each connected part, and the part ``(M,)`` of
        each point, numbered from 0.
    """
    edges = Edges.among(points, normals, neighbours)
    return spanning_tree_signs(len(points), edges.left, edges.right, edges.weights, edges.opposite)


def spanning_tree_signs(
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
        right: ``(E,)`` at the other; edges to numbers outside ``0..count-1`` are skipped.
        weights: ``(E,)``, none negative.
        opposite: ``(E,)`` whether the signs of the two ends differ.

    Returns:
        As `SignedUnionFind.read`: signs -1 or 1 ``(count,)`` and the part ``(count,)`` of each node.
    """
    forest = SignedUnionFind(count)
    forest.join(left, right, opposite, _by_weight(weights.view(np.uint32)))
    return forest.read()


def row_dots(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """Products of rows, ``(N,)``."""
    products: NDArray[Any] = np.einsum("ij,ij->i", left, right)
    return products


@njit(cache=True, nogil=True)
def _pairs(
    points: NDArray[Any],
    neighbours: NDArray[Any],
    left: NDArray[Any],
    right: NDArray[Any],
    short: NDArray[Any],
) -> int:
    """Write each pair of neighbours once, and for each point what is a short edge there."""
    count, width = neighbours.shape
    found = 0
    for i in range(count):
        total, degree = 0.0, 0
        for k in range(width):
            j = neighbours[i, k]
            if not 0 <= j < count or j == i:
                continue
            squared = 0.0
            for a in range(3):
                squared += (points[j, a] - points[i, a]) ** 2
            total += np.sqrt(squared)
            degree += 1
            written = False
            if j < i:
                for other in neighbours[j]:
                    written |= other == i
            if not written:
                left[found], right[found] = i, j
                found += 1
        short[i] = _SHORT * total / max(degree, 1)
    return found


@njit(cache=True, nogil=True)
def _compare(
    points: NDArray[Any],
    normals: NDArray[Any],
    left: NDArray[Any],
    right: NDArray[Any],
    short: NDArray[Any],
    weights: NDArray[Any],
    opposite: NDArray[Any],
) -> None:
    """Weights of the edges, and whether normals disagree there.

    The left normal is reflected in the plane midway between both points before it is compared,
    which on a circle gives the right normal exactly. Plain dot products would orient both sides
    of a thin wall the same way.
    """
    for at in range(len(left)):
        i, j = left[at], right[at]
        x, y, z = (
            points[j, 0] - points[i, 0],
            points[j, 1] - points[i, 1],
            points[j, 2] - points[i, 2],
        )
        length = np.sqrt(x * x + y * y + z * z)
        inverse = 1.0 / length if length > 0.0 else 1.0
        here = (normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z) * inverse
        there = (normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z) * inverse
        cosine = -2.0 * here * there
        for a in range(3):
            cosine += normals[i, a] * normals[j, a]
        # Two points that noise has put above each other look like the two sides of a wall.
        # Such edges are short; the edges that go around a sharp rim are of common length.
        ratio = min(short[i], short[j]) * inverse
        shortness = min(ratio * ratio * ratio * ratio, 1.0) if length > 0.0 else 1.0
        steepness = max(here * here, there * there)
        weights[at] = max(1.0 - abs(cosine) + steepness * shortness, 0.0)
        opposite[at] = cosine < 0.0


@njit(cache=True, nogil=True)
def _by_weight(bits: NDArray[np.uint32]) -> NDArray[np.int32]:
    """Stable order of float32 numbers, none negative, by their upper bits, eight at a time.

    Which of two edges comes first that differ by less than a hundredth decides nothing.
    """
    order = np.arange(len(bits)).astype(np.int32)
    other = np.empty_like(order)
    for shift in (16, 24):
        start = np.zeros(257, dtype=np.int64)
        for value in bits:
            start[((value >> shift) & 255) + 1] += 1
        for digit in range(256):
            start[digit + 1] += start[digit]
        for at in order:
            digit = (bits[at] >> shift) & 255
            other[start[digit]] = at
            start[digit] += 1
        order, other = other, order
    return order
