# SPDX-License-Identifier: Apache-2.0
"""Warnings about coordinates in which distances mean nothing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["coordinate_warnings"]

_SAMPLED = 1000
_STEEP = 300.0
"""Height range over horizontal range from which x and y in +-180, +-90 count as degrees. A degree
is 111 km, so that a landscape in degrees has 1000 and more; a pole in metres has 100 or less."""


def coordinate_warnings(points: NDArray[Any]) -> tuple[str, ...]:
    """Sentences about degrees beside metres, and about float32 steps wider than the spacing.

    Args:
        points: ``(M, 3)`` finite, without duplicates, cloud units.
    """
    found: list[str] = []
    if len(points) < 2:
        return ()
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    if not (np.abs([low, high]) < 1e300).all():
        return ()
    wide, tall = float((high - low)[:2].max()), float(high[2] - low[2])
    inside = max(abs(low[0]), abs(high[0])) <= 180 and max(abs(low[1]), abs(high[1])) <= 90
    if inside and 0 < wide * _STEEP < tall:
        found.append(
            "x and y look like degrees beside heights in metres: project them to metres first, "
            "since distances between the two mean nothing."
        )
    step = float(np.spacing(np.float32(min(np.abs([low, high]).max(), 1e38))))
    if (high - low).max() < 1e7 * step and _are_float32(points):
        # Else steps are fine: float32 has 1.7e7 of them between two powers of two.
        spacing = _median_spacing(points)
        if step > 0.5 * spacing:
            found.append(
                f"Coordinates have the precision of float32, whose steps are {step:.2g} here, but "
                f"points are {spacing:.2g} apart: detail was lost before the file was written. "
                "Export with an offset (shift) or as double."
            )
    return tuple(found)


def _are_float32(points: NDArray[Any]) -> bool:
    """True if float32 holds all coordinates exactly."""
    if points.dtype == np.float32:
        return True
    with np.errstate(over="ignore"):
        return bool((points.astype(np.float32) == points).all())


def _median_spacing(points: NDArray[Any]) -> float:
    """Median distance of sampled points from their nearest neighbour."""
    values = points.astype(np.float64)
    rows = np.linspace(0, len(points) - 1, min(len(points), _SAMPLED)).astype(np.int64)
    tree = cKDTree(values, balanced_tree=False, compact_nodes=False)
    return float(np.median(np.asarray(tree.query(values[rows], k=2)[0])[:, 1]))
