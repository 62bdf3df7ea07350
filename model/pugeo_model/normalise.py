# SPDX-License-Identifier: Apache-2.0
"""Taking offset and scale out in float64, so that a georeferenced scan loses nothing."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.errors import UntreatableCloudError

__all__ = ["FEWEST", "Normalisation", "normalise"]

FEWEST = 8
"""Points without which no neighbourhood has a curvature."""

_THIN = 1e-5  # second extent over first below which points count as lying on a line


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Where the cloud lay: ``world = scale * unit + offset``.

    Attributes:
        offset: ``(3,)`` float64, centre of the bounding box.
        scale: longest side of the bounding box.
        dtype: dtype of the input's points, which the output gets again.
    """

    offset: NDArray[np.float64]
    scale: float
    dtype: Any

    def unit(self, point: tuple[float, float, float]) -> tuple[float, float, float]:
        """A point of the cloud's own frame in the unit frame."""
        x, y, z = (np.asarray(point, np.float64) - self.offset) / self.scale
        return float(x), float(y), float(z)

    def world(self, points: NDArray[np.float64]) -> NDArray[Any]:
        """Points back in the input's frame and precision, ``(K, 3)``."""
        placed: NDArray[Any] = (points * self.scale + self.offset).astype(self.dtype)
        return placed


def normalise(points: NDArray[Any]) -> tuple[NDArray[np.float64], Normalisation]:
    """Centre on the bounding box and scale its longest side to 1.

    Args:
        points: ``(M, 3)``, finite and distinct.

    Raises:
        UntreatableCloudError: fewer than 8 points, or all on one line.
    """
    if len(points) < FEWEST:
        raise UntreatableCloudError(
            f"{len(points)} distinct finite points are left; at least {FEWEST} are needed",
            code="too_few_points",
            limit=FEWEST,
            value=len(points),
        )
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    # Halved before they are added or subtracted: the ends may lie 1e308 apart.
    offset, half = low / 2 + high / 2, high / 2 - low / 2
    scale = float(half.max()) * 2
    unit = (points.astype(np.float64) - offset) / scale
    values = np.linalg.eigvalsh(np.cov(unit.T))
    if values[1] < _THIN**2 * values[2]:
        raise UntreatableCloudError(
            "all points lie on one line: they span no surface", code="collinear_points"
        )
    return unit, Normalisation(offset, scale, points.dtype)
