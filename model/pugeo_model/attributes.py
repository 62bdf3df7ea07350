# SPDX-License-Identifier: Apache-2.0
"""Interpolation of colours, continuous scalars and labels at new points."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.tuning import TUNING

__all__ = ["mark_labels", "transfer_attributes"]

_BLOCK_ROWS = 65_536
_SEVERAL = 3
"""Whole values that a float column must have at least before it counts as labels."""

# Names of quantities whose average means nothing, compared in lower case without a prefix
# "scalar_" (CloudCompare) and without anything but letters and digits.
_LABEL_NAMES = re.compile(
    r"label\w*|\w*class(ification|es|id)?|class\d*|category|segment\w*|instance\w*|cluster\w*|object\w*"
    r"|(number)?(of)?returns?(number|s)?|numberofreturns?|returnnumber|echo\w*"
    r"|(\w*gps|adjusted|std|sensor|scan|\w*pulse)?time(stamp)?(s|ns|us|ms)?|t|timestamp\w*|tow"
    r"|\w+id|id|idx|index|\w+index|ring|line|scanline|row|column|col|channel|scannerchannel"
    r"|rgba?|packedrgba?|\w*flags?|mask|valid|userdata|edgeofflightline|scandirection(flag)?"
    r"|synthetic|keypoint|withheld|overlap|scan"
)


def mark_labels(cloud: Cloud) -> Cloud:
    """Find the floating scalars whose values must be those of one point, never an average.

    These are columns whose known values are all whole (of three or more points), and columns whose
    name says so: labels, classes, return numbers, times, identifiers, packed colours, flags. Both
    kinds are written as floats by programs that know no other type. A GPS time stays within its
    flight line, because it is the time of a real pulse.

    Args:
        cloud: the whole cloud: a part of it could look whole by chance.

    Returns:
        The cloud with ``labels``, and a note that names those found by their values alone.
    """
    named, whole = set(cloud.labels), []
    for name, values in cloud.scalars.items():
        if values.dtype.kind != "f" or name in named:
            continue
        if _LABEL_NAMES.fullmatch(_plain(name)):
            named.add(name)
        elif _are_whole(values):
            whole.append(name)
    notes = cloud.notes
    if whole:
        listed = ", ".join(whole)
        note = "Scalars with whole values only are taken from the nearest point, not averaged: "
        notes += (f"{note}{listed}.",)
    return replace(cloud, labels=frozenset([*named, *whole]), notes=notes)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower().removeprefix("scalar_"))


def _are_whole(values: NDArray[Any]) -> bool:
    known = values[np.isfinite(values)]
    return len(known) >= _SEVERAL and bool((known == np.rint(known)).all())


def transfer_attributes(
    source: Cloud, targets: NDArray[np.float64]
) -> tuple[NDArray[np.uint8] | NDArray[np.uint16] | None, dict[str, NDArray[Any]]]:
    """Interpolate the colours and scalars of a cloud at other points.

    Colours and continuous scalars are the mean over the three nearest source points, weighted by
    inverse distance (Shepard 1968); a target on a source point gets the value of that point.
    Values that are not finite are excluded from the mean; if all three are not finite, the nearest
    one is taken. Integer and boolean scalars, and those in ``source.labels``, are copied from the
    nearest point, since a mean of two classes would be a third.

    Args:
        source: ``M`` points (at least one, all finite) with colours and scalars.
        targets: ``(K, 3)`` float64, in the frame of the source.

    Returns:
        ``(K, 3|4)`` colours of the source's dtype or ``None``, and scalars ``(K,)`` of the
        source's dtypes.
    """
    if source.colors is None and not source.scalars:
        return None, {}
    count = len(targets)
    colors: NDArray[Any] | None = None
    if source.colors is not None:
        colors = np.empty((count, source.colors.shape[1]), source.colors.dtype)
    scalars = {name: np.empty(count, values.dtype) for name, values in source.scalars.items()}
    points = source.points.astype(np.float64, copy=False)
    # A list of ranks keeps the result two-dimensional, also for one neighbour.
    ranks = np.arange(1, min(TUNING.attribute_neighbours, len(points)) + 1)
    tree = cKDTree(points)
    for start in range(0, count, _BLOCK_ROWS):
        part = slice(start, start + _BLOCK_ROWS)
        rows: NDArray[Any] = np.asarray(tree.query(targets[part], k=ranks)[1])
        weights = _weights(points, targets[part], rows)
        if colors is not None and source.colors is not None:
            mean = np.einsum("kn,knc->kc", weights, source.colors[rows])
            colors[part] = np.rint(mean / weights.sum(axis=1, keepdims=True))
        for name, values in source.scalars.items():
            if values.dtype.kind == "f" and name not in source.labels:
                scalars[name][part] = _mean(values[rows], weights)
            else:
                scalars[name][part] = values[rows[:, 0]]
    return colors, scalars


def _weights(
    points: NDArray[np.float64], targets: NDArray[np.float64], rows: NDArray[Any]
) -> NDArray[np.float64]:
    """Inverse-distance weights ``(K, k)``; the nearest point has weight 1."""
    distances = np.linalg.norm(points[rows] - targets[:, None, :], axis=2)
    least = distances.min(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):  # 0 / 0 for a target on a source point
        return np.where(distances == least, 1.0, least / distances)


def _mean(values: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted means of the finite values ``(K, k)``; the first value if none is finite."""
    finite = np.isfinite(values)
    used = np.where(finite, weights, 0.0)
    total = used.sum(axis=1)
    known = total > 0.0
    # Weights are normalised first and the mean is clipped, since sums of huge values overflow.
    shares = used / np.where(known, total, 1.0)[:, None]
    with np.errstate(over="ignore"):
        mean = (shares * np.where(finite, values, 0.0)).sum(axis=1)
    low = np.where(finite, values, np.inf).min(axis=1)
    high = np.where(finite, values, -np.inf).max(axis=1)
    return np.where(known, np.clip(mean, low, high), values[:, 0])
