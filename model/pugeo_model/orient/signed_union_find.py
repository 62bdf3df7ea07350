# SPDX-License-Identifier: Apache-2.0
"""Nodes joined into parts, each with a sign: union-find that knows who is turned over."""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["SignedUnionFind"]


class SignedUnionFind:
    """Parts of ``count`` nodes, within each of which signs are known relative to each other.

    Args:
        count: number of nodes, each at first a part of its own.
    """

    def __init__(self, count: int) -> None:
        # Twice the row that a node leads to, and one more if the signs of the two differ: one look
        # into memory instead of two. The root of a part is its lowest row.
        self._links = 2 * np.arange(count, dtype=np.int32)
        self.parts = count

    def join(
        self,
        left: NDArray[np.integer[Any]],
        right: NDArray[np.integer[Any]],
        opposite: NDArray[np.bool_],
        order: NDArray[np.integer[Any]] | None = None,
    ) -> None:
        """Join parts along edges; an edge within a part is passed over, whatever it says.

        Args:
            left: ``(E,)`` node at one end of each edge.
            right: ``(E,)`` at the other; edges to numbers outside ``0..count-1`` are skipped.
            opposite: ``(E,)`` whether the signs of the two ends differ.
            order: rows of the edges to go along, in turn; all as they come if ``None``.
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
        """Join parts along edges that weigh at most so much, as they come, level by level.

        Args:
            left: ``(E,)`` node at one end of each edge.
            right: ``(E,)`` at the other, in ``0..count-1`` too.
            opposite: ``(E,)`` whether the signs of the two ends differ.
            weights: ``(E,)``.
            levels: ascending.

        Returns:
            Rows of the edges, ascending, that lie between two parts after it.
        """
        most = np.array(levels, dtype=np.float32)
        joined, between = _join_sure(self._links, left, right, opposite, weights, most)
        self.parts -= joined
        return between

    def lowest(self) -> NDArray[np.intp]:
        """The lowest row of each part, ascending."""
        return np.flatnonzero(self._links >> 1 == np.arange(len(self._links)))

    def read(self) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Signs -1 or 1 and parts of all nodes, ``(count,)`` each.

        The sign of the lowest row of each part is 1; parts are numbered in the order of these rows.
        """
        signs, parts = np.empty(len(self._links)), np.empty(len(self._links), dtype=np.intp)
        _read(self._links, signs, parts)
        return signs, parts


@njit(cache=True, nogil=True)
def _root(links: NDArray[np.int32], row: int) -> int:
    """Link of a row to the root of its part; shortens the way there."""
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
def _unite(links: NDArray[np.int32], here: int, there: int, opposite: int) -> None:
    """Join the parts of two roots, whose links these are."""
    low, high = min(here, there), max(here, there)
    links[high >> 1] = (low & -2) + ((low ^ high ^ opposite) & 1)


@njit(cache=True, nogil=True)
def _join(
    links: NDArray[np.int32],
    left: NDArray[Any],
    right: NDArray[Any],
    opposite: NDArray[Any],
    order: NDArray[Any],
    apart: int,
) -> int:
    count, joined = len(links), 0
    for edge in order:
        if joined == apart:
            break
        i, j = left[edge], right[edge]
        if not 0 <= j < count:
            continue
        here, there = _root(links, i), _root(links, j)
        if here >> 1 != there >> 1:
            _unite(links, here, there, opposite[edge])
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
    joined, kept = 0, len(left)
    rows = np.arange(len(left)).astype(np.int32)
    for most in levels:
        heavier = 0
        for at in range(kept):
            edge = rows[at]
            # Not "heavier": a weight that is no number is not sure.
            if not weights[edge] <= most:
                rows[heavier] = edge
                heavier += 1
                continue
            here, there = _root(links, left[edge]), _root(links, right[edge])
            if here >> 1 != there >> 1:
                _unite(links, here, there, opposite[edge])
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
    total = 0
    for i in range(len(links)):
        link = _root(links, i)
        root = link >> 1
        signs[i] = -1.0 if link & 1 else 1.0
        # The root is the lowest row of its part, so it has come already.
        if root == i:
            parts[i] = total
            total += 1
        else:
            parts[i] = parts[root]
