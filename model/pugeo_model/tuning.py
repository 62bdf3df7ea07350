# SPDX-License-Identifier: Apache-2.0
"""The numbers of the method that trade quality against something, in one place.

Each has a unit, a range in which it was tried or makes sense, and the reason for its value;
``docs/reference/tuning.md`` prints them. Numbers that only bound memory, name a layout or guard
against division by zero stay where they are used.
"""

from dataclasses import dataclass, field
from typing import Any

__all__ = ["TUNING", "Tuning"]


def _number(default: Any, unit: str, low: float, high: float, reason: str) -> Any:
    return field(default=default, metadata={"unit": unit, "range": (low, high), "reason": reason})


@dataclass(frozen=True)
class Tuning:
    """Numbers of the method; compiled kernels read them when this package is imported."""

    # Canonical frames (geometry/frames.py)
    fit_support: float = _number(
        1.6, "spacings", 1.2, 3.0,
        "Gaussian support of the quadric fit on clean input; wider rounds edges",
    )  # fmt: skip
    fit_support_noisy: float = _number(
        3.0, "spacings", 1.6, 4.0,
        "support on the noisiest input; 32 neighbours reach no further",
    )  # fmt: skip
    fit_support_gain: float = _number(
        6.0, "spacings of support a spacing of residual", 0.0, 12.0,
        "how fast the support widens with the height residual of the first fit",
    )  # fmt: skip
    noise_quantile: float = _number(
        0.1, "1", 0.05, 0.5,
        "quantile of the residuals that counts as noise: most of a shape has some detail",
    )  # fmt: skip
    clean_residual: float = _number(
        0.06, "spacings", 0.0, 0.1,
        "residual that curvature alone leaves on clean input",
    )  # fmt: skip

    # Noise (denoise.py)
    noisy: float = _number(
        0.1, "spacings", 0.05, 0.3,
        "noise from which the input is moved onto its charts: even validation inputs with 1 % noise "
        "have 0.11 to 0.28, with 2 % 0.2 to 0.4; without noise most have less, detail up to 0.22",
    )  # fmt: skip
    exact_move: float = _number(
        0.03, "spacings", 0.01, 0.04,
        "median move under projection up to which the input is exact: 0.002 on clean and even "
        "validation inputs, 0.023 on random ones, 0.04 to 0.18 with 1 % noise",
    )  # fmt: skip

    # Density (geometry/areas.py)
    area_rounds: int = _number(
        8, "rounds", 2, 12,
        "times that areas are averaged over neighbours: the density is followed, its accidents "
        "are not",
    )  # fmt: skip
    even_area: float = _number(
        0.06, "log of the ratio to the typical area", 0.0, 0.1,
        "differences of area up to here are taken for accidents of an even input",
    )  # fmt: skip
    uneven_area: float = _number(
        0.18, "log of the ratio to the typical area", 0.1, 0.4,
        "differences of area from here on are taken as they are",
    )  # fmt: skip

    # Candidates and projection (plan.py, resample/, network/)
    oversampling: float = _number(
        1.5, "candidates a point wanted", 1.2, 3.0,
        "more give the elimination more choice and cost projection time",
    )  # fmt: skip
    fewest_candidates: int = _number(
        4, "candidates a chart", 2, 8,
        "fewer would leave the elimination no choice at small ratios",
    )  # fmt: skip
    many_candidates: int = _number(
        12, "candidates a chart", 8, 48,
        "from here on (R=8) candidates are projected onto one chart instead of two: 17 % of the "
        "time of projection at R=16, P2F 0.5 % worse; at R=4 evenness would lose",
    )  # fmt: skip
    blended_charts: int = _number(
        3, "charts", 1, 4,
        "charts that a point of the answer is blended from",
    )  # fmt: skip
    furthest: float = _number(
        1.25, "spacings", 0.9, 2.0,
        "distance from its input point that a point may lie at most: the widest holes of an even "
        "scan are 0.85 deep, and what a chart says beyond is invention",
    )  # fmt: skip

    # Elimination (resample/elimination.py, Yuksel 2015, and resample/selection.py)
    weight_limit: float = _number(
        0.65, "1", 0.5, 0.8,
        "weight limiting (section 3.2 there): without it the spacing of survivors varies by 11 % "
        "instead of 8 %",
    )  # fmt: skip
    weight_limit_power: float = _number(
        1.5, "1", 1.0, 2.0,
        "exponent of the weight limiting, as published",
    )  # fmt: skip
    levelling_at: float = _number(
        1.3, "times the survivors", 1.1, 2.0,
        "number left when regions that kept too many get more weight",
    )  # fmt: skip
    levelling_power: float = _number(
        6, "1", 0, 8,
        "power of a region's density by which its weights grow then",
    )  # fmt: skip
    error_penalty: float = _number(
        0.1, "weight a usual error", 0.0, 0.5,
        "penalty of a candidate for each usual error that its own expected error is beyond",
    )  # fmt: skip
    usual_error: float = _number(
        0.85, "times the error around", 0.5, 2.0,
        "errors that bring no penalty, times R to the power below",
    )  # fmt: skip
    usual_error_power: float = _number(
        0.68, "1", 0.0, 1.0,
        "among more points a hole is worse than an error, so that more error is allowed",
    )  # fmt: skip
    usual_error_least: float = _number(
        2.2, "times the error around", 1.5, 3.0,
        "with less there are holes at R=2",
    )  # fmt: skip
    usual_error_most: float = _number(
        5.6, "times the error around", 4.0, 8.0,
        "with more the tips of thin fins are overshot",
    )  # fmt: skip

    # Repulsion (resample/repulsion.py)
    repulsion_rounds: int = _number(
        6, "rounds", 0, 12,
        "evenness against time; rounds after the sixth change it by less than 1 %",
    )  # fmt: skip
    repulsion_step: float = _number(
        0.65, "of the mean push", 0.3, 0.8,
        "six rounds of it do what eight of 0.5 do, and 0.8 is uneven",
    )  # fmt: skip
    repulsion_range: float = _number(
        1.3, "packing radii", 1.0, 2.0,
        "distance within which survivors push each other",
    )  # fmt: skip

    # Orientation (orient/)
    orientation_neighbours: int = _number(
        12, "neighbours", 6, 32,
        "edges a point in the graph that carries signs: more cost time and mend little",
    )  # fmt: skip
    orientation_members: int = _number(
        3, "points a chart", 1, 8,
        "points of a chart whose signs are searched; the others follow the nearest of these",
    )  # fmt: skip
    sure_edges: tuple[float, ...] = _number(
        (0.003, 0.01), "edge weight", 0.0, 0.03,
        "edges that are joined without a vote: normals on one circle to 4 degrees, then to 8; up "
        "to 0.03 costs 2 % of the signs at 2 % noise",
    )  # fmt: skip
    short_edge: float = _number(
        0.6, "of the local mean length", 0.0, 1.0,
        "shorter edges are mistrusted, since noise puts points above each other: on training "
        "shapes with 0 to 1 % noise 94 % of the signs are right instead of 88 %",
    )  # fmt: skip
    clear_volume: float = _number(
        0.05, "of area times radius", 0.01, 0.2,
        "enclosed volume below which a surface is as good as open; a closed one has 1/3 or more",
    )  # fmt: skip

    # Tiles (tiles.py)
    margin: float = _number(
        6.5, "spacings", 4.0, 8.0,
        "reach of the blend of charts and of their messages; 4 to 8 made no difference on "
        "validation shapes in tiles of 1,250 points",
    )  # fmt: skip
    charted_margin: float = _number(
        3.0, "spacings", 2.0, 6.5,
        "points of the margin within it get charts; figures are unchanged down to 2",
    )  # fmt: skip


TUNING = Tuning()
