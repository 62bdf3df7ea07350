# SPDX-License-Identifier: Apache-2.0
"""Stray points: isolated points far off the surface of the points around them."""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.quadric_at_points import heights_over_neighbours
from pugeo_model.tuning import TUNING

__all__ = ["stray_points"]


def stray_points(
    rows: NDArray[np.intp],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    spacing: NDArray[np.float64],
    usual: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Find stray points among some points.

    A point is isolated if its spacing exceeds the usual spacing around it; an isolated point is
    stray if it is far off the robust quadric of its neighbours, in standard deviations and in
    spacings, or very isolated.

    Args:
        rows: ``(n,)`` rows of the points.
        points: ``(M, 3)``.
        neighbours: ``(n, k)`` of the nearest, in order.
        spacing: ``(n,)`` own spacing of each.
        usual: ``(n,)`` usual spacing around each.

    Returns:
        ``(n,)`` bool.
    """
    stray = spacing > TUNING.stray_isolation * usual
    isolated = np.flatnonzero(~stray & (spacing > TUNING.isolation * usual))
    if len(isolated):
        height, thickness = heights_over_neighbours(rows[isolated], points, neighbours[isolated])
        least = np.maximum(
            TUNING.stray_deviations * thickness, TUNING.stray_height * usual[isolated]
        )
        stray[isolated] = height > least
    return stray
