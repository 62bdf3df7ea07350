# SPDX-License-Identifier: Apache-2.0
"""Denoising: points of a noisy input are moved onto the charts that were predicted from them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pugeo_model.prepare import PreparedTile
from pugeo_model.resample.atlas import Projected
from pugeo_model.tiles import NoisyInput, Tile
from pugeo_model.tuning import TUNING

__all__ = ["denoised_tile", "input_is_exact", "needs_denoising"]


def needs_denoising(prepared: PreparedTile) -> bool:
    """Return whether the input is noisy, is not part of the output, and was not moved yet."""
    tile = prepared.tile
    if tile.patch_ratio is not None:
        # Networks that upsample whole patches predict no charts to move points onto.
        return False
    return prepared.noise > TUNING.noise_threshold and not tile.unmoved and tile.noisy is None


def input_is_exact(prepared: PreparedTile, projected: NDArray[np.float64]) -> bool:
    """Return whether the input lies on the surface: projection hardly moves half of its points.

    Args:
        prepared: the tile.
        projected: ``(charted, 3)`` float64, its charted points after projection, unit scale.
    """
    return _move_of_noise(prepared, projected) is None


def _move_of_noise(prepared: PreparedTile, projected: NDArray[np.float64]) -> float | None:
    """Median distance of points from their projections, in spacings; ``None`` if it is too small.

    The residuals of such a tile are detail, not noise. Arguments as for `input_is_exact`.
    """
    moved = np.linalg.norm(projected - prepared.charted_points, axis=1)
    median = float(np.median(moved / prepared.frames.spacing[: len(projected)]))
    return median if median >= TUNING.exact_input_move else None


def denoised_tile(prepared: PreparedTile, projected: Projected) -> Tile | None:
    """Replace the points of a noisy tile by their projections; the result is prepared again.

    Frames and quadrics that are fitted to denoised points are more accurate.

    Args:
        prepared: the noisy tile; all its points have charts.
        projected: its points on their charts.

    Returns:
        The tile, or ``None`` if the points hardly moved: the residuals are then detail, not
        noise, and the charts stay valid.
    """
    moved = _move_of_noise(prepared, projected.points)
    if moved is None:
        return None
    points = np.empty_like(prepared.points)
    points[prepared.order] = projected.points
    noisy = NoisyInput(prepared.noise, np.median(prepared.frames.spacing), moved)
    return replace(prepared.tile, points=points, noise=None, noisy=noisy)
