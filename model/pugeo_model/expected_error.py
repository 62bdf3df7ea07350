# SPDX-License-Identifier: Apache-2.0
"""Expected error of output points: the distance from the true surface to be expected of each.

The network is trained to predict the log of ``distance + FLOOR`` of its candidates, in spacings of
the input. Where the input is noisy, what is left of the noise comes on top. Two factors turn both
into a mean distance:

    E|d| = (factor * (e - FLOOR) + noise * m) * spacing

with the predicted error ``e``, and the median distance ``m`` by which denoising moved the input
points, both in spacings. The distance of the move tells noise from detail better than residuals do.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.tuning import TUNING

__all__ = ["EXPECTED_ERROR", "FLOOR", "ErrorFactors", "expected_errors"]

EXPECTED_ERROR = "expected_error"
"""Name of the scalar."""

FLOOR = 0.005
"""Added to distances in training, in spacings, so that their log is finite."""

_LEAST = 0.0005  # spacings; half of the resolution of the prediction at its floor
_USUAL_MOVE = 0.6  # median move of points in denoising, in noise levels
_MEAN_OF_NORMAL = 0.8  # mean of |x| of a normal distribution, in standard deviations


@dataclass(frozen=True)
class ErrorFactors:
    """Factors of a network, from its model card.

    Attributes:
        factor: of the predicted error.
        noise: of the distance by which denoising moved the input.
    """

    factor: float = 1.25
    noise: float = 0.5

    @classmethod
    def of_card(cls, card: dict[str, Any]) -> "ErrorFactors":
        """Read the member ``expected_error`` of a card; usual factors where it is missing."""
        return cls(**card.get("expected_error", {}))


def expected_errors(
    prepared: PreparedTile, projected: Projected, factors: ErrorFactors
) -> NDArray[np.float32]:
    """Compute the expected distance of points from the true surface, ``(K,)``, unit scale.

    Args:
        prepared: the tile.
        projected: its output points.
        factors: of the network.
    """
    tile = prepared.tile
    predicted = np.maximum(projected.error - np.float32(FLOOR), _LEAST)
    error = factors.factor * predicted + factors.noise * _move(prepared)
    if tile.keeps_input and not tile.moves_input:
        # Input points that are not moved keep all of their noise.
        own = _MEAN_OF_NORMAL * prepared.noise if _is_noisy(prepared) else 0.0
        error[: tile.kept] = np.maximum(error[: tile.kept], own)
    unit: NDArray[np.float32] = error * prepared.frames.spacing[projected.nearest]
    return unit.astype(np.float32)


def _move(prepared: PreparedTile) -> float:
    """Median distance by which denoising moved the points, or would have, in spacings."""
    noisy = prepared.tile.noisy
    if noisy is not None:
        return noisy.moved
    return _USUAL_MOVE * prepared.noise if _is_noisy(prepared) else 0.0


def _is_noisy(prepared: PreparedTile) -> bool:
    """Return whether noise was measured on points that were averaged, or that stay."""
    tile = prepared.tile
    undecided = tile.input is not None or (tile.keeps_input and not tile.moves_input)
    return undecided and prepared.noise > TUNING.noise_threshold
