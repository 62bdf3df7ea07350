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
    """Return whether the input is noisy, may be moved, and was not moved yet."""
    tile = prepared.tile
    if tile.patch_ratio is not None:
        # Networks that upsample whole patches predict no charts to move points onto.
        return False
    may_move = tile.moves_input or not tile.keeps_input
    return prepared.noise > TUNING.noise_threshold and may_move and tile.noisy is None


def input_is_exact(prepared: PreparedTile, projected: NDArray[np.float64]) -> bool:
    """Return whether the input lies on the surface: projection hardly moves half of its points.

    Args:
        prepared: the tile.
        projected: ``(charted, 3)`` float64, its charted points after projection, unit scale.
    """
    return _median_move(prepared, projected) < TUNING.exact_input_move


def _median_move(prepared: PreparedTile, projected: NDArray[np.float64]) -> float:
    """Median distance of charted points from their projections ``(charted, 3)``, in spacings."""
    moved = np.linalg.norm(projected - prepared.charted_points, axis=1)
    return float(np.median(moved / prepared.frames.spacing[: len(projected)]))


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
    moved = _median_move(prepared, projected.points)
    if moved < TUNING.exact_input_move:
        return None
    points = np.empty_like(prepared.points)
    points[prepared.order] = projected.points
    noisy = NoisyInput(prepared.noise, np.median(prepared.frames.spacing), moved)
    return replace(prepared.tile, points=points, noise=None, noisy=noisy)
