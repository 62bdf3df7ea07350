# SPDX-License-Identifier: Apache-2.0
"""Depth steps: one coordinate that takes few values, as that of depth cameras.

A camera rounds depth or disparity, so that a wall becomes terraces. Inside a terrace nothing shows
the error, so the steps are found from the values themselves: many points share each exactly.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.quadric_at_points import QuadricsAtPoints
from pugeo_model.geometry.regions import Regions, usual_regions
from pugeo_model.tuning import TUNING

__all__ = ["DepthSteps", "find_depth_steps"]

_SHARED = 8  # points from which a value is one of a step
_FEWEST_VALUES = 6  # of a cloud with steps: a box has two
_NEARLY_ALL = 0.95  # share of the points on such values
_SMOOTHED = 5  # gaps in a row whose median is the step: values may be missing
_IRREGULAR = 0.1  # relative change from step to step; a pixel's own coordinates change more
_EQUAL = 0.02  # relative difference of equal steps
_EXACT = 1e-4  # spacings: residual of a fit inside one terrace, rounding included
_FEWEST_EXACT = 0.05  # share of the points inside terraces, below which no axis is sought
_ROUNDING = 2e-6  # of the longest side: rounding errors of a cloud that was turned
_CLOSER = (0.03, 0.003, 0.0003)  # radians around the common normal, in turn


@dataclass(frozen=True, eq=False)
class DepthSteps:
    """Steps of the depth of all points.

    Attributes:
        axis: ``(3,)`` unit vector along which depth is measured.
        step: ``(M,)`` float64 distance to the next value, unit scale.
    """

    axis: NDArray[np.float64]
    step: NDArray[np.float64]

    def least_spacing(
        self, spacing: NDArray[np.float64], regions: list[Regions]
    ) -> NDArray[np.float64]:
        """Least spacing of charts with which steps are averaged, 0 where they do not matter.

        Args:
            spacing: ``(M,)`` of the points, unit scale.
            regions: that contain the points, from small to large.

        Returns:
            ``(M,)`` float64, unit scale.
        """
        least = np.zeros(len(spacing))
        matters = self.step > TUNING.least_step * spacing
        for region in regions:
            step = region.medians(self.step)
            cosine = np.abs(region.axis @ self.axis)
            slope = np.sqrt(np.maximum(1.0 - cosine**2, 1e-12)) / np.maximum(cosine, 1e-12)
            flat = region.spreads_two_ways & (
                (region.third <= TUNING.flat_region * region.second)
                | (region.third <= TUNING.step_of_flat * step)
            )
            several = region.side * slope >= TUNING.terraces * step
            # Values are rounded evenly, so that their error has a standard deviation of
            # step / sqrt(12). A terrace is step / slope wide, the ball of a chart four spacings.
            error = cosine * step / np.sqrt(12.0)
            needed = np.maximum(TUNING.terraces / 4.0 * step / slope, error / TUNING.thin_sheet)
            now = np.where(flat & several, needed, 0.0)[region.of_point]
            noticed = error[region.of_point] > TUNING.lattice_noise * spacing
            now = np.where(noticed & (now > 0.0), np.maximum(now, TUNING.step_merge * spacing), now)
            least = np.where((least == 0.0) & matters, now, least)
        return least


def find_depth_steps(
    points: NDArray[np.float64], near: QuadricsAtPoints, regions: list[Regions]
) -> DepthSteps | None:
    """Find the axis along which the points are rounded.

    Args:
        points: ``(M, 3)``, unit scale.
        near: of these points.
        regions: that contain the points, from small to large.

    Returns:
        ``None`` if there is no such axis, or if the values are those of a raster or of voxels.
    """
    least = TUNING.least_step * float(np.median(near.spacing))
    found = [(axis, _steps(points @ axis, 0.0, least)) for axis in np.eye(3)]
    rounded = [DepthSteps(axis, step) for axis, step in found if step is not None]
    if rounded:
        return None if _are_voxels(rounded) else _faced(rounded, usual_regions(regions))
    inside = near.thickness < _EXACT
    if np.count_nonzero(inside) < max(_FEWEST_EXACT * len(points), _SHARED):
        return None
    axis = _common_normal(near.normal[inside])
    step = _steps(points @ axis, _ROUNDING, least)
    return None if step is None else DepthSteps(axis, step)


def _steps(
    values: NDArray[np.float64], tolerance: float, least: float
) -> NDArray[np.float64] | None:
    """Distance from each value ``(M,)`` to the next; ``None`` if not rounded to steps that matter.

    Values within the tolerance are the same; smaller steps than the least do not matter.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    starts = np.flatnonzero(np.append(True, np.diff(ordered) > tolerance))
    count = np.diff(np.append(starts, len(values)))
    shared = count >= _SHARED
    if count[shared].sum() < _NEARLY_ALL * len(values) or shared.sum() < _FEWEST_VALUES:
        return None
    gaps = np.diff(ordered[starts[shared]])
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(gaps, _SMOOTHED // 2, mode="edge"), _SMOOTHED
    )
    usual = np.median(around, axis=1)
    if np.median(usual) < least or np.median(np.abs(gaps - usual) / usual) > _IRREGULAR:
        return None
    level = np.clip(np.cumsum(shared) - 1, 0, len(usual) - 1)
    step = np.empty(len(values))
    step[order] = np.repeat(usual[level], count)
    return step


def _are_voxels(rounded: list[DepthSteps]) -> bool:
    """Return whether all three axes are rounded to the same steps."""
    usual = [float(np.median(steps.step)) for steps in rounded]
    return len(usual) == 3 and max(usual) - min(usual) <= _EQUAL * max(usual)


def _faced(rounded: list[DepthSteps], region: Regions) -> DepthSteps | None:
    """Return the axis that the surface faces most; ``None`` if that one is not rounded.

    It faces the height of a raster and of scan lines, whose places are rounded.
    """
    facing = np.median(np.abs(region.axis), axis=0)
    axis = np.eye(3)[int(np.argmax(facing))]
    return next((steps for steps in rounded if steps.axis @ axis == 1.0), None)


def _common_normal(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normal that most of the normals share: that of the terraces."""
    axis: NDArray[np.float64] = np.linalg.eigh(normals.T @ normals)[1][:, 2]
    for angle in _CLOSER:
        cosine = normals @ axis
        close = np.abs(cosine) > np.cos(angle)
        if not close.any():
            break
        axis = (normals[close] * np.sign(cosine[close])[:, None]).sum(axis=0)
        axis /= np.linalg.norm(axis)
    return axis
