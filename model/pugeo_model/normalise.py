# SPDX-License-Identifier: Apache-2.0
"""Normalisation of coordinates: offset and scale removed in float64, exact for large offsets."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pugeo_model.errors import UntreatableCloudError

__all__ = ["FEWEST", "Normalisation", "normalise"]

FEWEST = 8
"""Smallest number of points: fewer determine no curvature."""

_SMALLEST, _LARGEST = 1e-300, 1.7e308  # longest side, so that quotients stay exact
_THIN = 1e-5  # ratio of the second to the first extent below which points count as collinear


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Map between the cloud's own frame and the unit frame: ``world = scale * unit + offset``.

    Attributes:
        offset: ``(3,)`` float64, centre of the bounding box, cloud units.
        scale: longest side of the bounding box, cloud units.
        dtype: float32 or float64, of the input's points; the output has the same.
    """

    offset: NDArray[np.float64]
    scale: float
    dtype: Any

    def unit(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform points ``(K, 3)`` or ``(3,)`` from the cloud's own frame to the unit frame."""
        unit: NDArray[np.float64] = (np.asarray(points, np.float64) - self.offset) / self.scale
        return unit

    def world(self, points: NDArray[np.float64]) -> NDArray[Any]:
        """Transform points ``(K, 3)`` to the cloud's own frame and dtype."""
        world: NDArray[Any] = (points * self.scale + self.offset).astype(self.dtype)
        return world


def normalise(points: NDArray[Any]) -> tuple[NDArray[np.float64], Normalisation]:
    """Centre on the bounding box and scale its longest side to 1.

    Args:
        points: ``(M, 3)``, finite and distinct.

    Raises:
        UntreatableCloudError: fewer than 8 points, or all on one line.

    Returns:
        ``(M, 3)`` float64 in -0.5..0.5, and the map back.
    """
    if len(points) < FEWEST:
        raise UntreatableCloudError(
            f"{len(points)} distinct finite points are left; at least {FEWEST} are needed",
            code="too_few_points",
            limit=FEWEST,
            value=len(points),
        )
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    # Halved first: sum and difference could overflow, since coordinates reach 1e308.
    offset, half = low / 2 + high / 2, high / 2 - low / 2
    scale = float(half.max()) * 2
    if not _SMALLEST <= scale <= _LARGEST:
        raise UntreatableCloudError(
            f"the longest side of the cloud is {2 * (half.max() / 10.0**300):.3g}e300; it must lie "
            f"between {_SMALLEST:g} and {_LARGEST:g}: rescale the coordinates"
            if scale > 1.0
            else f"the longest side of the cloud is {scale:.3g}; it must lie between "
            f"{_SMALLEST:g} and {_LARGEST:g}: rescale the coordinates",
            code="extent_out_of_range",
            limit=[_SMALLEST, _LARGEST],
        )
    unit = (points.astype(np.float64) - offset) / scale
    values = np.linalg.eigvalsh(np.cov(unit.T))
    if values[1] < _THIN**2 * values[2]:
        raise UntreatableCloudError(
            "all points lie on one line: they span no surface", code="collinear_points"
        )
    return unit, Normalisation(offset, scale, points.dtype)
