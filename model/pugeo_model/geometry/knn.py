# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours of all points of a cloud at once, leaf by leaf of a k-d tree.

The points of a leaf look for the same neighbours, so what lies around the leaf is gathered once
and every point compares itself with all of it: loops without branches, several times faster than
one descent of the tree a point. Points with too much around them are left to the caller.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["nearest_by_leaves"]

_LEAF = 32  # points of a leaf at most, half as many at least
_REACH = 0.48  # of the diagonal of a box with as many points as are wanted: seldom too short
_MOST = 2048  # points gathered around a leaf
_TINY = 1e-150
_SHELVES = 64  # by squared distance: what lies on one is then sorted by insertion
_WORD = 8  # flags looked at together


def nearest_by_leaves(
    points: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The ``count`` nearest of each point, itself left out.

    Args:
        points: ``(M, 3)``, more than ``count``.
        count: neighbours wanted.

    Returns:
        Distances and rows, both ``(M, count)``, nearest first and lower rows first among equals.
        Rows of a point that was left out are -1.
    """
    distances = np.empty((len(points), count), dtype=np.float32)
    rows = np.full((len(points), count), -1, dtype=np.int32)
    order = np.arange(len(points), dtype=np.int32)
    boxes, child, part = _grow(points, order)
    _search(points, boxes, child, part, order, distances, rows)
    return distances, rows


@njit(cache=True, nogil=True)
def _halve(values, order, start, stop, middle):  # type: ignore[no-untyped-def]
    """Put the rows of the lowest values of ``start..stop`` before ``middle`` (quickselect)."""
    while stop - start > 1:
        a, b, c = values[order[start]], values[order[(start + stop) // 2]], values[order[stop - 1]]
        pivot = max(min(a, b), min(max(a, b), c))
        low, high = start, stop - 1
        while low <= high:
            while values[order[low]] < pivot:
                low += 1
            while values[order[high]] > pivot:
                high -= 1
            if low <= high:
                order[low], order[high] = order[high], order[low]
                low += 1
                high -= 1
        if middle <= high:
            stop = high + 1
        elif middle >= low:
            start = low
        else:
            return


@njit(cache=True, nogil=True)
def _grow(points, order):  # type: ignore[no-untyped-def]
    """Sort ``order`` into the leaves of a tree.

    Returns:
        Boxes ``(nodes, 6)`` (lowest and highest corner), first child ``(nodes,)`` (its sister
        follows; 0 for a leaf) and the part of ``order`` that each holds ``(nodes, 2)``.
    """
    columns = points.T.copy()
    most = 4 * (len(points) // _LEAF + 1)
    boxes = np.empty((most, 6))
    child = np.zeros(most, dtype=np.int32)
    part = np.empty((most, 2), dtype=np.int32)
    part[0, 0], part[0, 1] = 0, len(points)
    nodes, at = 1, 0
    while at < nodes:
        start, stop = part[at]
        widest, side = 0, -1.0
        for axis in range(3):
            low = high = columns[axis, order[start]]
            for row in order[start:stop]:
                low = min(low, columns[axis, row])
                high = max(high, columns[axis, row])
            boxes[at, axis], boxes[at, 3 + axis] = low, high
            if high - low > side:
                widest, side = axis, high - low
        if stop - start > _LEAF:
            middle = (start + stop) // 2
            _halve(columns[widest], order, start, stop, middle)
            child[at] = nodes
            part[nodes, 0], part[nodes, 1] = start, middle
            part[nodes + 1, 0], part[nodes + 1, 1] = middle, stop
            nodes += 2
        at += 1
    return boxes[:nodes], child[:nodes], part[:nodes]


@njit(cache=True, nogil=True)
def _gather(leaf, reach, boxes, child, part, stack, order, points, around, rows):  # type: ignore[no-untyped-def]
    """Points of the leaf, then of all other leaves in its reach; how many, -1 if too many."""
    count = 0
    for at in range(part[leaf, 0], part[leaf, 1]):
        rows[count] = order[at]
        count += 1
    stack[0] = 0
    depth = 1
    while depth:
        depth -= 1
        node = stack[depth]
        squared = 0.0
        for axis in range(3):
            gap = max(
                boxes[node, axis] - boxes[leaf, 3 + axis], boxes[leaf, axis] - boxes[node, 3 + axis]
            )
            if gap > 0.0:
                squared += gap * gap
        if squared > reach * reach or node == leaf:
            continue
        if child[node]:
            stack[depth], stack[depth + 1] = child[node], child[node] + 1
            depth += 2
            continue
        if count + part[node, 1] - part[node, 0] > _MOST:
            return -1
        for at in range(part[node, 0], part[node, 1]):
            rows[count] = order[at]
            count += 1
    for at in range(count):
        for axis in range(3):
            around[axis, at] = points[rows[at], axis]
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _compare(own, count, limit, around, squared, within):  # type: ignore[no-untyped-def]
    """Squared distances to all that was gathered, and which are within the limit."""
    x, y, z = around[0, own], around[1, own], around[2, own]
    for at in range(count):
        a = around[0, at] - x
        b = around[1, at] - y
        c = around[2, at] - z
        d = a * a + b * b + c * c
        squared[at] = d
        within[at] = d <= limit
    within[own] = 0


@njit(cache=True, nogil=True)
def _number(squared, scale):  # type: ignore[no-untyped-def]
    """Of the shelf of a squared distance."""
    return max(min(np.int64(squared * scale), _SHELVES - 1), 0)


@njit(cache=True, nogil=True)
def _shelve(count, limit, squared, words, within, picked, shelf):  # type: ignore[no-untyped-def]
    """List what is within the limit and count it by shelf; returns how many."""
    found = 0
    shelf[:] = 0
    scale = _SHELVES / limit
    for word in range(count // _WORD + 1):
        if words[word] == 0:
            continue
        for at in range(word * _WORD, word * _WORD + _WORD):
            if within[at]:
                picked[found] = at
                found += 1
                shelf[_number(squared[at], scale)] += 1
    return found


@njit(cache=True, nogil=True)
def _sort(found, wanted, limit, squared, rows, picked, shelf, keys, sorted_rows):  # type: ignore[no-untyped-def]
    """The ``wanted`` nearest to the front of ``keys`` and ``sorted_rows``, in order."""
    scale = _SHELVES / limit
    last = total = 0
    for at in range(_SHELVES):
        here = shelf[at]
        shelf[at] = total
        if total < wanted:
            last = at
        total += here
    for at in range(found):
        on = _number(squared[picked[at]], scale)
        if on <= last:
            keys[shelf[on]], sorted_rows[shelf[on]] = squared[picked[at]], rows[picked[at]]
            shelf[on] += 1
    for at in range(1, shelf[last]):
        key, row = keys[at], sorted_rows[at]
        to = at
        while to and (keys[to - 1] > key or (keys[to - 1] == key and sorted_rows[to - 1] > row)):
            keys[to], sorted_rows[to] = keys[to - 1], sorted_rows[to - 1]
            to -= 1
        keys[to], sorted_rows[to] = key, row


@njit(cache=True, nogil=True)
def _search(points, boxes, child, part, order, distances, found_rows):  # type: ignore[no-untyped-def]
    wanted = found_rows.shape[1]
    around, squared = np.empty((3, _MOST)), np.empty(_MOST)
    rows, picked = np.empty(_MOST, dtype=np.int32), np.empty(_MOST, dtype=np.int32)
    # One flag a point; eight of them are one word, and most words are zero.
    words = np.zeros(_MOST // _WORD + 1, dtype=np.uint64)
    within = words.view(np.uint8)
    shelf = np.empty(_SHELVES, dtype=np.int32)
    keys, sorted_rows = np.empty(_MOST), np.empty(_MOST, dtype=np.int32)
    stack = np.empty(128, dtype=np.int32)
    for leaf in range(len(boxes)):
        if child[leaf]:
            continue
        size = part[leaf, 1] - part[leaf, 0]
        diagonal = np.sqrt(((boxes[leaf, 3:] - boxes[leaf, :3]) ** 2).sum())
        # Never zero, whose multiples are no further.
        reach = max(_REACH * diagonal * np.sqrt(wanted / size), _TINY)
        todo = size
        while todo and reach < np.inf:
            count = _gather(leaf, reach, boxes, child, part, stack, order, points, around, rows)
            if count < 0:
                break
            limit = reach * reach
            within[count : (count // _WORD + 1) * _WORD] = 0
            todo = 0
            for own in range(size):
                i = rows[own]
                if found_rows[i, 0] >= 0:
                    continue
                _compare(own, count, limit, around, squared, within)
                found = _shelve(count, limit, squared, words, within, picked, shelf)
                if found < wanted:
                    todo += 1
                    continue
                _sort(found, wanted, limit, squared, rows, picked, shelf, keys, sorted_rows)
                for at in range(wanted):
                    distances[i, at] = np.sqrt(keys[at])
                    found_rows[i, at] = sorted_rows[at]
            reach *= 1.5
