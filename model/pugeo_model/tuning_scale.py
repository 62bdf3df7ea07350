# SPDX-License-Identifier: Apache-2.0
"""Constants of the local scale, which decide where a chart represents several points."""

from dataclasses import dataclass, field
from typing import Any

__all__ = ["ScaleTuning", "number"]


def number(default: Any, unit: str, low: float, high: float, reason: str) -> Any:
    """Define a constant with its unit, the range of sensible values, and the reason."""
    return field(default=default, metadata={"unit": unit, "range": (low, high), "reason": reason})


@dataclass(frozen=True)
class ScaleTuning:
    """Constants of the local scale and of stray points."""

    # Local scale (geometry/scale.py, geometry/centres.py, geometry/strays.py)
    averaged_noise: float = number(
        0.36, "spacings", 0.2, 0.6,
        "noise level of a region from which charts represent several points: below, detail is "
        "as fine as the noise (0.25 halves the error at 10,000 points and doubles it at 2,048)",
    )  # fmt: skip
    averaged_alike: float = number(
        0.8, "times averaged_noise", 0.6, 1.0,
        "noise level from which all regions of a cloud are averaged if one exceeds averaged_noise",
    )  # fmt: skip
    flat_noise: float = number(
        0.1, "spacings", 0.05, 0.3,
        "noise level from which a flat region is averaged, where no detail is lost",
    )  # fmt: skip
    only_noise: float = number(
        1.25, "times the usual noise", 1.1, 1.6,
        "third principal spread up to which a region has no other shape than noise",
    )  # fmt: skip
    least_kurtosis: float = number(
        2.2, "1", 1.9, 2.6,
        "kurtosis of the heights of a flat region from which they are noise: both sides of a thin "
        "plate have 1",
    )  # fmt: skip
    flat_merge: float = number(
        2.0, "spacings of the points", 1.2, 3.0,
        "least spacing of the charts of a noisy flat region",
    )  # fmt: skip
    stacked_order: float = number(
        0.75, "1", 0.5, 0.95,
        "share of the directions to nearest points along one axis from which frames are stacked",
    )  # fmt: skip
    stacked_slope: float = number(
        0.35, "cosine", 0.2, 0.7,
        "cosine between that axis and the normal: along the surface it is a scan line",
    )  # fmt: skip
    lattice_order: float = number(
        0.75, "1", 0.5, 0.95,
        "order of the nearest points, fourfold or sixfold, from which they are a lattice",
    )  # fmt: skip
    lattice_noise: float = number(
        0.05, "spacings", 0.02, 0.1,
        "residual from which a lattice is noisy",
    )  # fmt: skip
    flat_region: float = number(
        0.15, "of the second principal spread", 0.05, 0.3,
        "third principal spread up to which a region is flat and its normal is meaningful",
    )  # fmt: skip
    least_bias: float = number(
        5.0, "degrees", 2.0, 10.0,
        "angle between the mean normal of small neighbourhoods and that of their region, from "
        "which the former are false",
    )  # fmt: skip
    bias_of_curved: float = number(
        3.0, "times the third over the second spread", 1.6, 4.0,
        "the same angle, in radians, of a region that is not exactly flat: a cubic surface has at "
        "most 1.6",
    )  # fmt: skip
    least_step: float = number(
        0.2, "spacings", 0.1, 0.5,
        "depth step from which it matters: the charts average smaller ones",
    )  # fmt: skip
    step_of_flat: float = number(
        0.6, "steps", 0.4, 1.0,
        "third principal spread up to which a terraced region is flat: that of one step is 0.3",
    )  # fmt: skip
    terraces: float = number(
        3.0, "terraces", 2.0, 5.0,
        "terraces in the ball of a chart: fewer leave a slope, more flatten the shape",
    )  # fmt: skip
    step_merge: float = number(
        2.0, "spacings of the points", 1.0, 3.0,
        "least spacing of the charts of terraces",
    )  # fmt: skip
    across: float = number(
        60.0, "degrees", 50.0, 80.0,
        "median angle of the normals to the region's from which they are false; wires of a fence "
        "have 45",
    )  # fmt: skip
    surface_spread: float = number(
        0.3, "of the first principal spread", 0.15, 0.5,
        "second principal spread from which points are a surface and not a line",
    )  # fmt: skip
    tube: float = number(
        0.7, "of the second principal spread", 0.5, 0.9,
        "noise up to which points are a surface: that of a wire is the same in both directions",
    )  # fmt: skip
    tube_noise: float = number(
        0.25, "spacings", 0.2, 0.32,
        "residual of fits to few points from which a long region is searched for a curve: noise of "
        "two spacings and more around a wire has 0.32, thin parts of a scan 0.14",
    )  # fmt: skip
    slim_curve: float = number(
        0.3, "of the first principal spread", 0.15, 0.4,
        "noise up to which points are a curve",
    )  # fmt: skip
    curve_kurtosis: float = number(
        1.6, "1", 1.3, 1.9,
        "kurtosis of the distances from a curve from which they are noise, see `curve_fit`",
    )  # fmt: skip
    thin_sheet: float = number(
        0.28, "spacings of the charts", 0.2, 0.34,
        "noise that charts are left with: a larger one keeps more detail and more noise",
    )  # fmt: skip
    largest_scale: float = number(
        0.4, "longest sides", 0.1, 0.5,
        "spacing of charts up to which a surface is searched",
    )  # fmt: skip
    large_scale: float = number(
        0.1, "longest sides", 0.05, 0.2,
        "scale from which a thin part of the shape may look like noise",
    )  # fmt: skip
    round_ball: float = number(
        0.85, "of the first principal spread", 0.3, 0.95,
        "second principal spread from which such a scale counts",
    )  # fmt: skip
    mostly_large: float = number(
        0.5, "of the points", 0.2, 0.8,
        "share of the noisy points with such a scale, below which it does not count",
    )  # fmt: skip
    scale_ball: float = number(
        2.0, "spacings of the charts", 1.6, 2.4,
        "radius of the ball in which noise is measured; at 1.6 a quarter of the points of a "
        "noisy ball seemed thin by chance",
    )  # fmt: skip
    chart_ball: float = number(
        1.6, "spacings of the charts", 1.2, 2.4,
        "radius of the ball that a centre is fitted to; larger ones flatten",
    )  # fmt: skip
    curve_ball: float = number(
        2.8, "spacings of the charts", 1.6, 4.0,
        "radius of the ball that a centre on a curve is fitted to; a smaller one has few points",
    )  # fmt: skip
    least_chart_ball: float = number(
        2.4, "spacings of the points", 1.6, 3.2,
        "smallest such radius, so that enough points are inside",
    )  # fmt: skip
    least_merge: float = number(
        1.2, "spacings of the points", 1.0, 2.0,
        "least spacing of the charts of noisy points",
    )  # fmt: skip
    lattice_merge: float = number(
        1.5, "spacings of the points", 1.0, 2.0,
        "least spacing of the charts of a noisy lattice",
    )  # fmt: skip
    grading: float = number(
        0.6, "1", 0.3, 1.0,
        "growth of the spacing of charts with the distance from finer ones",
    )  # fmt: skip
    narrow_charts: float = number(
        2.0, "spacings of the points", 1.0, 3.0,
        "spacing of charts up to which it need not grow slowly: at 3 a wall has holes",
    )  # fmt: skip
    centre_distance: float = number(
        0.72, "spacings of the charts", 0.6, 0.85,
        "least distance of centres; their mean distance is then about a spacing",
    )  # fmt: skip
    region_quantile: float = number(
        0.2, "1", 0.05, 0.5,
        "quantile of the scales of a region that counts as small",
    )  # fmt: skip
    region_bound: float = number(
        1.2, "times the small scale of the region", 1.0, 2.0,
        "largest scale: a larger one is a thin part of the shape, not noise",
    )  # fmt: skip
    isolation: float = number(
        1.4, "times the spacing around", 1.2, 2.0,
        "own spacing from which a point may be stray",
    )  # fmt: skip
    stray_isolation: float = number(
        3.0, "times the spacing around", 2.0, 6.0,
        "own spacing from which a point is stray wherever it lies",
    )  # fmt: skip
    stray_deviations: float = number(
        6.0, "standard deviations", 4.0, 10.0,
        "height of an isolated point above its neighbours from which it is stray",
    )  # fmt: skip
    stray_height: float = number(
        0.8, "spacings", 0.5, 1.5,
        "least such height: none on clean inputs, 8 of 10 stray points of photogrammetry",
    )  # fmt: skip
