# SPDX-License-Identifier: Apache-2.0
"""Union-find with parity: connected parts of nodes with the relative sign of each node."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit

__all__ = ["SignedUnionFind"]


class SignedUnionFind:
    """Connected parts of nodes, with relative signs within each part (union-find with parity).

    Args:
        count: number of nodes; each is a part of its own at first.

    Attributes:
        parts: current number of parts.
    """

    def __init__(self, count: int) -> None:
        # Twice the row of the parent, plus one if the signs of node and parent differ: one memory
        # access instead of two. The root of a part is its lowest row.
        self._links = 2 * np.arange(count, dtype=np.int32)
        self.parts = count

    def join(
        self,
        left: NDArray[np.integer[Any]],
        right: NDArray[np.integer[Any]],
        opposite: NDArray[np.bool_],
        order: NDArray[np.integer[Any]] | None = None,
    ) -> None:
        """Join parts along edges, in order; edges within a part are ignored.

        Args:
            left: ``(E,)`` node at one end of each edge.
            right: ``(E,)`` node at the other end; numbers outside ``0..count-1`` are skipped.
            opposite: ``(E,)`` bool, whether the signs of the two ends differ.
            order: rows of the edges to use, in this order; by default all.
        """
        order = np.arange(len(left)) if order is None else order
        self.parts -= _join(self._links, left, right, opposite, order, self.parts - 1)

    def join_sure(
        self,
        left: NDArray[np.int32],
        right: NDArray[np.int32],
        opposite: NDArray[np.bool_],
        weights: NDArray[np.float32],
        levels: tuple[float, ...],
    ) -> NDArray[np.int32]:
        """Join parts along all edges up to a weight, for several weights in turn.

        Args:
            left: ``(E,)`` node at one end of each edge.
            right: ``(E,)`` node at the other end, in ``0..count-1``.
            opposite: ``(E,)`` bool, whether the signs of the two ends differ.
            weights: ``(E,)`` float32.
            levels: largest weights, ascending.

        Returns:
            Rows of the edges between different parts afterwards, ascending.
        """
        most = np.array(levels, dtype=np.float32)
        between: NDArray[np.int32]
        joined, between = _join_sure(self._links, left, right, opposite, weights, most)
        self.parts -= joined
        return between

    def lowest(self) -> NDArray[np.intp]:
        """Return the lowest row of each part, ascending."""
        return np.flatnonzero(self._links >> 1 == np.arange(len(self._links)))

    def read(self) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return the signs -1 or 1 and the parts of all nodes, ``(count,)`` each.

        The lowest row of each part has the sign 1; parts are numbered in the order of these rows.
        """
        signs, parts = np.empty(len(self._links)), np.empty(len(self._links), dtype=np.intp)
        _read(self._links, signs, parts)
        return signs, parts


@njit(cache=True, nogil=True)
def _root(links: NDArray[np.int32], row: int) -> int:
    """Link of a row to the root of its part, with path halving."""
    flip = 0
    link = links[row]
    while link >> 1 != row:
        link = links[link >> 1] ^ (link & 1)
        links[row] = link
        flip ^= link & 1
        row = link >> 1
        link = links[row]
    return 2 * row + flip


@njit(cache=True, nogil=True)
def _unite(links: NDArray[np.int32], one: int, other: int, opposite: int) -> None:
    """Join two parts, given the links of two nodes to their roots."""
    low, high = min(one, other), max(one, other)
    links[high >> 1] = (low & -2) + ((low ^ high ^ opposite) & 1)


@njit(cache=True, nogil=True)
def _join(
    links: NDArray[np.int32],
    left: NDArray[Any],
    right: NDArray[Any],
    opposite: NDArray[Any],
    order: NDArray[Any],
    most: int,
) -> int:
    """Join along edges until ``most`` joins are made; returns their number."""
    count, joined = len(links), 0
    for edge in order:
        if joined == most:
            break
        i, j = left[edge], right[edge]
        if not 0 <= j < count:
            continue
        one, other = _root(links, i), _root(links, j)
        if one >> 1 != other >> 1:
            _unite(links, one, other, opposite[edge])
            joined += 1
    return joined


@njit(cache=True, nogil=True)
def _join_sure(
    links: NDArray[np.int32],
    left: NDArray[Any],
    right: NDArray[Any],
    opposite: NDArray[Any],
    weights: NDArray[Any],
    levels: NDArray[np.float32],
) -> tuple[int, NDArray[np.int32]]:
    """Join level by level; returns the number of joins and the edges between parts."""
    joined, kept = 0, len(left)
    rows = np.arange(len(left)).astype(np.int32)
    for most in levels:
        heavier = 0
        for at in range(kept):
            edge = rows[at]
            # "not <=" instead of ">", so that an edge with weight NaN is not joined.
            if not weights[edge] <= most:
                rows[heavier] = edge
                heavier += 1
                continue
            one, other = _root(links, left[edge]), _root(links, right[edge])
            if one >> 1 != other >> 1:
                _unite(links, one, other, opposite[edge])
                joined += 1
        kept = heavier
    between = 0
    for at in range(kept):
        edge = rows[at]
        if _root(links, left[edge]) >> 1 != _root(links, right[edge]) >> 1:
            rows[between] = edge
            between += 1
    return joined, rows[:between]


@njit(cache=True, nogil=True)
def _read(links: NDArray[np.int32], signs: NDArray[Any], parts: NDArray[Any]) -> None:
    """Write the signs and parts of all nodes."""
    total = 0
    for i in range(len(links)):
        link = _root(links, i)
        root = link >> 1
        signs[i] = -1.0 if link & 1 else 1.0
        # The root is the lowest row of its part, so its number is known already.
        if root == i:
            parts[i] = total
            total += 1
        else:
            parts[i] = parts[root]
