# SPDX-License-Identifier: Apache-2.0
"""Partition of a cloud into compact parts of about equal size."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.aabb import bounds

__all__ = ["PATCH_SIZE", "divide", "partition"]

PATCH_SIZE = 2048
"""Largest core of a patch: its rings add a fifth, and its arrays fit the processor's caches."""


def partition(points: NDArray[np.float64], size: int = PATCH_SIZE) -> list[NDArray[np.int32]]:
    """Divide points by recursive bisection across the longest side of their bounding box.

    Args:
        points: ``(M, 3)`` float64.
        size: largest number of points in a part.

    Returns:
        Rows of each part, ascending, int32. The sizes differ by at most one, and the same points
        always give the same parts.
    """
    return divide(points, -(-len(points) // size))


def divide(points: NDArray[np.float64], total: int) -> list[NDArray[np.int32]]:
    """Divide points into so many parts; otherwise as `partition`."""
    finished: list[NDArray[np.int32]] = []
    pending = [(np.arange(len(points), dtype=np.int32), total)]
    while pending:
        rows, parts = pending.pop()
        if parts == 1:
            finished.append(np.sort(rows))
            continue
        low, high = bounds(points, rows)
        axis = int(np.argmax(high - low))
        left = parts // 2
        middle = len(rows) * left // parts
        order = np.argpartition(points[rows, axis], middle)
        pending.append((rows[order[middle:]], parts - left))
        pending.append((rows[order[:middle]], left))
    return finished
