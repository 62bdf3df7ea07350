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
        "fourfold order of the four nearest from which points are a lattice",
    )  # fmt: skip
    lattice_noise: float = number(
        0.05, "spacings", 0.02, 0.1,
        "residual from which a lattice is noisy",
    )  # fmt: skip
    surface_spread: float = number(
        0.3, "of the first principal spread", 0.15, 0.5,
        "second principal spread from which points are a surface and not a line",
    )  # fmt: skip
    thin_sheet: float = number(
        0.28, "spacings of the charts", 0.2, 0.34,
        "noise that charts are left with: a larger one keeps more detail and more noise",
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
