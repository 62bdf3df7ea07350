# SPDX-License-Identifier: Apache-2.0
"""Cutting a cloud into spatial partition of about equal size."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.aabb import bounds

__all__ = ["PATCH_SIZE", "partition"]

PATCH_SIZE = 2048
"""Core points of a patch at most: a fifth more rows for its rings, and the caches still hold it."""


def partition(points: NDArray[np.float64], size: int = PATCH_SIZE) -> list[NDArray[np.int32]]:
    """Rows of ``(M, 3)`` points in compact partition of at most ``size``, equal to within one.

    Halves are cut across the longest side, at the count that keeps all partition equal; each
    chunk's rows ascend. The same points give the same partition.
    """
    wanted = -(-len(points) // size)
    done: list[NDArray[np.int32]] = []
    todo = [(np.arange(len(points), dtype=np.int32), wanted)]
    while todo:
        rows, parts = todo.pop()
        if parts == 1:
            done.append(np.sort(rows))
            continue
        low, high = bounds(points, rows)
        axis = int(np.argmax(high - low))
        left = parts // 2
        middle = len(rows) * left // parts
        order = np.argpartition(points[rows, axis], middle)
        todo.append((rows[order[middle:]], parts - left))
        todo.append((rows[order[:middle]], left))
    return done
