# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours of all points of a cloud, leaf by leaf of a k-d tree.

The points of a leaf have mostly the same neighbours. The points around a leaf are gathered once,
and each point of the leaf is compared with all of them in loops without branches: several times
faster than one descent of the tree per point. Points with too many others around their leaf are
left to the caller.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit

__all__ = ["nearest_by_leaves"]

_LEAF = 32  # largest number of points in a leaf; the smallest is half of it
_RADIUS = 0.48  # first radius, of the diagonal of a box with `count` points: seldom too small
_MOST = 2048  # largest number of points gathered around a leaf
_TINY = 1e-150
_BUCKETS = 64  # of squared distances; the content of a bucket is sorted by insertion
_WORD = 8  # flags tested together


def nearest_by_leaves(
    points: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Find the ``count`` nearest neighbours of each point, without the point itself.

    Args:
        points: ``(M, 3)`` float64, more than ``count``.
        count: number of neighbours.

    Returns:
        Distances float32 and rows int32, both ``(M, count)``, nearest first, at equal distance
        lower rows first. The rows of a point that was not treated are -1.
    """
    distances = np.empty((len(points), count), dtype=np.float32)
    rows = np.full((len(points), count), -1, dtype=np.int32)
    order = np.arange(len(points), dtype=np.int32)
    boxes, child, part = _build_tree(points, order)
    _search(points, boxes, child, part, order, distances, rows)
    return distances, rows


@njit(cache=True, nogil=True)
def _select(values, order, start, stop, middle):  # type: ignore[no-untyped-def]
    """Move the rows of the lowest values in ``start..stop`` before ``middle`` (quickselect)."""
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
def _build_tree(points, order):  # type: ignore[no-untyped-def]
    """Build a k-d tree; sorts ``order`` by leaf.

    Returns:
        Boxes ``(nodes, 6)`` (lowest and highest corner), first child ``(nodes,)`` (the second one
        follows it; 0 for a leaf) and the range of ``order`` of each node ``(nodes, 2)``.
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
            _select(columns[widest], order, start, stop, middle)
            child[at] = nodes
            part[nodes, 0], part[nodes, 1] = start, middle
            part[nodes + 1, 0], part[nodes + 1, 1] = middle, stop
            nodes += 2
        at += 1
    return boxes[:nodes], child[:nodes], part[:nodes]


@njit(cache=True, nogil=True)
def _gather(leaf, radius, boxes, child, part, stack, order, points, around, rows):  # type: ignore[no-untyped-def]
    """Gather the points of a leaf and of all leaves within a radius; returns their number.

    Returns -1 if there are too many.
    """
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
        if squared > radius * radius or node == leaf:
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
def _compare(point, count, limit, around, squared, within):  # type: ignore[no-untyped-def]
    """Squared distances to all gathered points, and flags of those within the limit."""
    x, y, z = around[0, point], around[1, point], around[2, point]
    for at in range(count):
        a = around[0, at] - x
        b = around[1, at] - y
        c = around[2, at] - z
        d = a * a + b * b + c * c
        squared[at] = d
        within[at] = d <= limit
    within[point] = 0


@njit(cache=True, nogil=True)
def _bucket(squared, scale):  # type: ignore[no-untyped-def]
    """Bucket of a squared distance."""
    return max(min(np.int64(squared * scale), _BUCKETS - 1), 0)


@njit(cache=True, nogil=True)
def _count_buckets(count, limit, squared, words, within, picked, buckets):  # type: ignore[no-untyped-def]
    """List the points within the limit and count them by bucket; returns their number."""
    found = 0
    buckets[:] = 0
    scale = _BUCKETS / limit
    for word in range(count // _WORD + 1):
        if words[word] == 0:
            continue
        for at in range(word * _WORD, word * _WORD + _WORD):
            if within[at]:
                picked[found] = at
                found += 1
                buckets[_bucket(squared[at], scale)] += 1
    return found


@njit(cache=True, nogil=True)
def _sort(found, wanted, limit, squared, rows, picked, buckets, keys, sorted_rows):  # type: ignore[no-untyped-def]
    """Sort the ``wanted`` nearest to the front of ``keys`` and ``sorted_rows`` (bucket sort)."""
    scale = _BUCKETS / limit
    last = total = 0
    for at in range(_BUCKETS):
        size = buckets[at]
        buckets[at] = total
        if total < wanted:
            last = at
        total += size
    for at in range(found):
        bucket = _bucket(squared[picked[at]], scale)
        if bucket <= last:
            to = buckets[bucket]
            keys[to], sorted_rows[to] = squared[picked[at]], rows[picked[at]]
            buckets[bucket] += 1
    for at in range(1, buckets[last]):
        key, row = keys[at], sorted_rows[at]
        to = at
        while to and (keys[to - 1] > key or (keys[to - 1] == key and sorted_rows[to - 1] > row)):
            keys[to], sorted_rows[to] = keys[to - 1], sorted_rows[to - 1]
            to -= 1
        keys[to], sorted_rows[to] = key, row


@njit(cache=True, nogil=True)
def _search(points, boxes, child, part, order, distances, found_rows):  # type: ignore[no-untyped-def]
    """Search leaf by leaf, with growing radii until all points of a leaf have enough neighbours."""
    wanted = found_rows.shape[1]
    around, squared = np.empty((3, _MOST)), np.empty(_MOST)
    rows, picked = np.empty(_MOST, dtype=np.int32), np.empty(_MOST, dtype=np.int32)
    # One flag per point; eight are tested as one word, since most are zero.
    words = np.zeros(_MOST // _WORD + 1, dtype=np.uint64)
    within = words.view(np.uint8)
    buckets = np.empty(_BUCKETS, dtype=np.int32)
    keys, sorted_rows = np.empty(_MOST), np.empty(_MOST, dtype=np.int32)
    stack = np.empty(128, dtype=np.int32)
    for leaf in range(len(boxes)):
        if child[leaf]:
            continue
        size = part[leaf, 1] - part[leaf, 0]
        diagonal = np.sqrt(((boxes[leaf, 3:] - boxes[leaf, :3]) ** 2).sum())
        # Never zero, since the radius grows by a factor.
        radius = max(_RADIUS * diagonal * np.sqrt(wanted / size), _TINY)
        unfinished = size
        while unfinished and radius < np.inf:
            count = _gather(leaf, radius, boxes, child, part, stack, order, points, around, rows)
            if count < 0:
                break
            limit = radius * radius
            within[count : (count // _WORD + 1) * _WORD] = 0
            unfinished = 0
            for point in range(size):
                i = rows[point]
                if found_rows[i, 0] >= 0:
                    continue
                _compare(point, count, limit, around, squared, within)
                found = _count_buckets(count, limit, squared, words, within, picked, buckets)
                if found < wanted:
                    unfinished += 1
                    continue
                _sort(found, wanted, limit, squared, rows, picked, buckets, keys, sorted_rows)
                for at in range(wanted):
                    distances[i, at] = np.sqrt(keys[at])
                    found_rows[i, at] = sorted_rows[at]
            radius *= 1.5
