# SPDX-License-Identifier: Apache-2.0
"""Cleaning of the input: non-finite, wild and duplicate points and bad normals are dropped."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.orient.given import usable_normals
from pugeo_model.outliers import wild_points

__all__ = ["Dropped", "clean"]

# Multipliers of splitmix64 (Steele, Lea and Flood 2014), one a coordinate.
_MULTIPLIERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


@dataclass(frozen=True)
class Dropped:
    """Numbers of dropped points.

    Attributes:
        non_finite: points with a NaN or infinite coordinate.
        duplicate: points with exactly the coordinates of an earlier point (-0.0 equals 0.0).
        wild: points so far away that the others would shrink to a spot, see `wild_points`.
    """

    non_finite: int
    duplicate: int
    wild: int = 0


def clean(cloud: Cloud) -> tuple[Cloud, Dropped]:
    """Drop non-finite points, wild points and duplicates; the first of each duplicate stays.

    Normals that cannot be used become zero or are left out, with a note, see `usable_normals`.

    Args:
        cloud: as read.

    Returns:
        The cloud, in the input's order, and the numbers of dropped points. If no point is
        dropped, no array is copied. The time is that of sorting ``M`` integers.
    """
    finite = _finite_rows(cloud.points)
    non_finite = len(cloud) - int(np.count_nonzero(finite))
    if non_finite:
        cloud = cloud.take(finite)
    wild = wild_points(cloud.points)
    if wild.any():
        cloud = cloud.take(~wild)
    repeated = _repeated_rows(cloud.points)
    if len(repeated):
        keep = np.ones(len(cloud), np.bool_)
        keep[repeated] = False
        cloud = cloud.take(keep)
    return usable_normals(cloud), Dropped(non_finite, len(repeated), int(np.count_nonzero(wild)))


def _finite_rows(rows: NDArray[Any]) -> NDArray[np.bool_]:
    finite: NDArray[np.bool_] = np.isfinite(rows[:, 0])
    for column in rows.T[1:]:
        finite &= np.isfinite(column)
    return finite


def _repeated_rows(points: NDArray[Any]) -> NDArray[np.intp]:
    """Find the rows that equal an earlier row.

    Sorting one 64-bit hash for each row is ten times faster than sorting rows, and enough for
    most clouds. Rows with equal hashes are compared before one is dropped: a collision (by chance
    or by design) costs time, but drops no point.
    """
    hashes = _hash(points)
    ordered = np.sort(hashes)
    if not (ordered[1:] == ordered[:-1]).any():
        return np.empty(0, np.intp)
    # Stable sorts keep equal rows in the input's order, so that the first is kept.
    order = np.argsort(hashes, kind="stable")
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    repeated: NDArray[np.intp] = order[same + 1]
    if (points[repeated] != points[order[same]]).any():
        order = np.lexsort(points.T)
        rows = points[order]
        repeated = order[1:][(rows[1:] == rows[:-1]).all(axis=1)]
    return repeated


def _hash(points: NDArray[Any]) -> NDArray[np.uint64]:
    unsigned = np.dtype(f"u{points.dtype.itemsize}")
    hashes = np.zeros(len(points), np.uint64)
    for column, factor in zip(points.T, _MULTIPLIERS, strict=True):
        # Adding zero copies the column and gives -0.0 the bits of 0.0, since the two are equal.
        hashes ^= (column + column.dtype.type(0)).view(unsigned)
        hashes *= np.uint64(factor)
        hashes ^= hashes >> np.uint64(29)
    return hashes
