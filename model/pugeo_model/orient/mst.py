# SPDX-License-Identifier: Apache-2.0
"""Relative signs of normals along a minimum spanning tree (Hoppe et al. 1992).

An edge joins two neighbouring points. Its weight is small where their normals, up to sign, agree
with one smooth surface, and signs propagate along the edges of smallest weight (Kruskal 1956).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.tuning import TUNING

__all__ = ["Edges", "spanning_tree_signs"]

_SHORT = TUNING.short_edge


@dataclass(frozen=True, eq=False)
class Edges:
    """Pairs of points with a comparison of their normals.

    Attributes:
        left: ``(E,)`` int32 row of one end.
        right: ``(E,)`` int32 row of the other end.
        weights: ``(E,)`` float32 in 0..2, small where the comparison is reliable.
        opposite: ``(E,)`` bool, whether one of the two normals has to be flipped.
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
        """Compare the normals of the two ends of given edges.

        Args:
            points: ``(M, 3)`` float64, near the origin.
            normals: ``(M, 3)`` float, unit length, of any sign.
            left: ``(E,)`` row of one end.
            right: ``(E,)`` row of the other end.
            short: ``(M,)`` length below which an edge of a point is less reliable.
        """
        weights = np.empty(len(left), dtype=np.float32)
        opposite = np.empty(len(left), dtype=np.bool_)
        _compare(points, normals, left, right, short, weights, opposite)
        return cls(left, right, weights, opposite)

    def shifted(self, offset: int) -> "Edges":
        """Return the edges with ``offset`` added to all rows."""
        offset32 = np.int32(offset)
        return replace(self, left=self.left + offset32, right=self.right + offset32)

    @classmethod
    def among(
        cls, points: NDArray[Any], normals: NDArray[Any], neighbours: NDArray[np.integer[Any]]
    ) -> "Edges":
        """Create the edges between neighbours, each pair once.

        Args:
            points: ``(M, 3)`` float64, near the origin.
            normals: ``(M, 3)`` float, unit length, of any sign.
            neighbours: ``(M, k)`` rows near each point; numbers outside ``0..M-1`` are skipped.
        """
        left, right = np.empty((2, neighbours.size), dtype=np.int32)
        short = np.empty(len(points))
        count = _pairs(points, neighbours, left, right, short)
        return cls.between(points, normals, left[:count], right[:count], short)


def spanning_tree_signs(
    count: int,
    left: NDArray[np.integer[Any]],
    right: NDArray[np.integer[Any]],
    weights: NDArray[np.float32],
    opposite: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Determine signs of nodes along a minimum spanning tree (Kruskal 1956).

    Args:
        count: number of nodes.
        left: ``(E,)`` node at one end of each edge.
        right: ``(E,)`` node at the other end; edges to numbers outside ``0..count-1`` are skipped.
        weights: ``(E,)`` float32, non-negative.
        opposite: ``(E,)`` bool, whether the signs of the two ends differ.

    Returns:
        Signs -1 or 1 ``(count,)`` and the connected part ``(count,)`` of each node, see
        `SignedUnionFind.read`.
    """
    union_find = SignedUnionFind(count)
    union_find.join(left, right, opposite, _by_weight(weights.view(np.uint32)))
    return union_find.read()


@njit(cache=True, nogil=True)
def _pairs(
    points: NDArray[Any],
    neighbours: NDArray[Any],
    left: NDArray[Any],
    right: NDArray[Any],
    short: NDArray[Any],
) -> int:
    """Write each pair of neighbours once, and the length of a short edge at each point."""
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
    """Weights of edges, and whether the two normals point to opposite sides.

    The left normal is reflected in the plane midway between the points before the comparison; on
    a circle this gives the right normal exactly. Dot products without the reflection would orient
    both sides of a thin wall the same way.
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
        left_dot = (normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z) * inverse
        right_dot = (normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z) * inverse
        cosine = -2.0 * left_dot * right_dot
        for a in range(3):
            cosine += normals[i, a] * normals[j, a]
        # Two points that noise puts above each other look like the two sides of a wall. Such
        # edges are short, while edges around a sharp rim have the usual length.
        ratio = min(short[i], short[j]) * inverse
        shortness = min(ratio * ratio * ratio * ratio, 1.0) if length > 0.0 else 1.0
        steepness = max(left_dot * left_dot, right_dot * right_dot)
        weights[at] = max(1.0 - abs(cosine) + steepness * shortness, 0.0)
        opposite[at] = cosine < 0.0


@njit(cache=True, nogil=True)
def _by_weight(bits: NDArray[np.uint32]) -> NDArray[np.int32]:
    """Stable radix sort of non-negative float32 numbers by the upper half of their bits.

    The order of two weights that differ by less than 1 % does not matter.
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
