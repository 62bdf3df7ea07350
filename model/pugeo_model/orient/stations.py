# SPDX-License-Identifier: Apache-2.0
"""Signs of normals from several scanner stations: towards the stations that saw each point.

If the file says which station recorded each point, that one counts. Otherwise a station sees the
points that are nearest to it among those in the same direction (a depth buffer on a grid of
directions).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.orient.signs import orient_along, row_dots
from pugeo_model.tuning import TUNING

__all__ = [
    "directions_to_stations",
    "directions_to_visible_stations",
    "orient_by_stations",
    "station_numbers",
]

_ROUNDS = 2
# Names of scalars, in small letters, that hold the station of each point.
_NUMBERS = frozenset({"scan", "station", "scanner", "scan_id", "station_id"})


def station_numbers(cloud: Cloud, count: int) -> NDArray[np.int64] | None:
    """Return the station that recorded each point ``(M,)``, ``None`` if the cloud does not say.

    Args:
        cloud: may have a scalar named ``scan``, ``station``, ``scanner``, ``scan_id`` or
            ``station_id``, in any case of letters, with numbers from 0 or from 1 on.
        count: number of stations.
    """
    for name, values in cloud.scalars.items():
        if name.lower() not in _NUMBERS or not np.isfinite(values).all():
            continue
        numbers = values.astype(np.int64)
        if (numbers != values).any():
            continue
        if numbers.min() >= 1 and numbers.max() == count:
            numbers = numbers - 1
        if numbers.min() >= 0 and numbers.max() < count:
            return numbers
    return None


def directions_to_stations(
    points: NDArray[np.float64],
    stations: NDArray[np.float64],
    numbers: NDArray[np.integer[Any]],
) -> NDArray[np.float32]:
    """Compute the unit vectors from each point to the station that recorded it, ``(M, 3)``.

    Args:
        points: ``(M, 3)``.
        stations: ``(k, 3)`` positions in the same frame.
        numbers: ``(M,)`` station of each point, ``0..k-1``.
    """
    return _unit(stations[numbers] - points).astype(np.float32)


def directions_to_visible_stations(
    points: NDArray[np.float64], stations: NDArray[np.float64], spacing: float
) -> NDArray[np.float32]:
    """Sum the unit vectors from each point to the stations that see it.

    Args:
        points: ``(M, 3)``.
        stations: ``(k, 3)`` positions in the same frame.
        spacing: typical distance of neighbouring points.

    Returns:
        ``(M, 3)``; zero for a point that no station sees.
    """
    total = np.zeros((len(points), 3))
    for station in stations:
        offset = station - points
        seen = _in_front(-offset, _lengths(offset), spacing)
        total[seen] += _unit(offset[seen])
    return total.astype(np.float32)


def orient_by_stations(
    normals: NDArray[Any], directions: NDArray[np.float32], neighbours: NDArray[np.integer[Any]]
) -> NDArray[Any]:
    """Give normals the sign that most of their neighbours' stations ask for.

    The vote of a neighbour is the cosine between its normal and its direction, so that grazing
    views hardly count.

    Args:
        normals: ``(M, 3)`` float, unit length, of any sign.
        directions: ``(M, 3)``, see `directions_to_visible_stations`.
        neighbours: ``(M, k)`` rows near each point.

    Returns:
        ``(M, 3)`` of the dtype of ``normals``.
    """
    votes = row_dots(normals, directions).astype(np.float64)
    for _ in range(_ROUNDS):
        # Products of two votes keep the signs of the axes consistent between neighbours.
        cosines = np.einsum("ij,ikj->ik", normals, normals[neighbours])
        around = (cosines * np.abs(cosines) * votes[neighbours]).sum(axis=1)
        votes = votes + around / neighbours.shape[1]
    return orient_along(normals, normals * votes[:, None])


def _in_front(
    offset: NDArray[np.float64], distance: NDArray[np.float64], spacing: float
) -> NDArray[np.bool_]:
    """Return which points are the first in their direction from a station, ``(M,)``."""
    width = TUNING.visibility_width * spacing / max(float(np.median(distance)), 1e-300)
    ray = offset / np.maximum(distance, 1e-300)[:, None]
    # A cube map: the largest coordinate selects a face, the other two a cell of it.
    axis = np.abs(ray).argmax(axis=1)
    rows = np.arange(len(ray))
    main = ray[rows, axis]
    face = 2 * axis + (main < 0)
    first = ray[rows, (axis + 1) % 3] / np.abs(main)
    second = ray[rows, (axis + 2) % 3] / np.abs(main)
    cells = max(int(2.0 / max(width, 1e-5)), 1)
    row, column = (
        np.minimum(((u + 1.0) * 0.5 * cells).astype(np.int64), cells - 1) for u in (first, second)
    )
    key = (face * cells + row) * cells + column
    unique, inverse = np.unique(key, return_inverse=True)
    nearest = np.full(len(unique), np.inf)
    np.minimum.at(nearest, inverse, distance)
    seen: NDArray[np.bool_] = distance <= nearest[inverse] + TUNING.visibility_depth * spacing
    return seen


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.maximum(_lengths(vectors), 1e-300)[:, None]
    return unit


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths ``(M,)``, also where squares of the components would be infinite."""
    largest = np.maximum(np.abs(vectors).max(axis=1), 1e-300)
    lengths: NDArray[np.float64] = largest * np.linalg.norm(vectors / largest[:, None], axis=1)
    return lengths
