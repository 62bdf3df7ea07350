# SPDX-License-Identifier: Apache-2.0
"""Expected error of output points: the mean distance from the true surface of points like each.

The network is trained to predict the log of ``distance + FLOOR`` of its candidates, in spacings of
the input. Where the input is noisy, what is left of the noise comes on top:

    E|d| = (1.25 (e - FLOOR) + 0.5 m) spacing

with the predicted error ``e``, and the median distance ``m`` by which denoising moved the input
points, both in spacings. The distance of the move tells noise from detail better than residuals do.
Both factors are fitted to the validation shapes (``python -m benchmarks.expected_error``); the
same ones suit all released weights.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.tuning import TUNING

__all__ = ["EXPECTED_ERROR", "FLOOR", "expected_errors"]

EXPECTED_ERROR = "expected_error"
"""Name of the scalar."""

FLOOR = 0.005
"""Added to distances in training, in spacings, so that their log is finite."""

_PREDICTED, _MOVED = np.float32(1.25), 0.5  # factors of the predicted error and of the move
_LEAST = np.float32(0.0005)  # spacings: predictions near the floor tell no smaller errors
_USUAL_MOVE = 0.6  # median move in denoising over the noise level
_MEAN_OF_NORMAL = 0.8  # mean of |x| of a normal distribution over its standard deviation


def expected_errors(prepared: PreparedTile, projected: Projected) -> NDArray[np.float32]:
    """Compute the expected distance of points from the true surface, ``(K,)``, unit scale.

    Args:
        prepared: the tile.
        projected: its output points.
    """
    tile = prepared.tile
    noise = _remaining_noise(prepared)
    move = tile.noisy.moved if tile.noisy is not None else _USUAL_MOVE * noise
    predicted = np.maximum(projected.error - np.float32(FLOOR), _LEAST)
    error = _PREDICTED * predicted + np.float32(_MOVED * move)
    # Input points that are not moved keep all of their noise.
    own = np.float32(_MEAN_OF_NORMAL * noise)
    error[: tile.unmoved] = np.maximum(error[: tile.unmoved], own)
    unit: NDArray[np.float32] = error * prepared.frames.spacing[projected.nearest]
    return unit


def _remaining_noise(prepared: PreparedTile) -> float:
    """Noise level of points that denoising did not move, in spacings; 0 if it is detail."""
    tile = prepared.tile
    # Denoising was tried and hardly moved the points, so the residuals are detail.
    was_tried = tile.input is None and not tile.unmoved
    return 0.0 if was_tried or prepared.noise <= TUNING.noise_threshold else prepared.noise
