# SPDX-License-Identifier: Apache-2.0
"""Numeric constants of the method that trade quality against time or another aspect of quality.

Each has a unit, a range of sensible values and the reason for its value. Constants that bound
memory, describe a layout, avoid a division by zero or are part of a trained network stay where
they are used. ``python -m pugeo_model.tuning`` prints the table in ``docs/reference/tuning.md``.
"""

from dataclasses import dataclass, fields

from pugeo_model.tuning_scale import ScaleTuning, number

__all__ = ["TUNING", "Tuning", "table"]


@dataclass(frozen=True)
class Tuning(ScaleTuning):
    """Constants of the method; compiled kernels read them once, on import."""

    # Canonical frames (geometry/frames.py, geometry/quadric.py)
    fit_support: float = number(
        1.6, "spacings", 1.2, 3.0,
        "Gaussian support of the quadric fit on clean input; a wider one rounds edges",
    )  # fmt: skip
    fit_support_noisy: float = number(
        3.0, "spacings", 1.6, 4.0,
        "largest support, on noisy input; 32 neighbours extend no further",
    )  # fmt: skip
    fit_support_gain: float = number(
        6.0, "spacings of support per spacing of noise", 0.0, 12.0,
        "increase of the support with the noise level of the cloud",
    )  # fmt: skip
    fit_ridge: float = number(
        0.02, "of 1/8 of the total weight", 0.001, 0.1,
        "ridge term of the quadric fit: a larger one flattens, a smaller one overfits sparse "
        "neighbourhoods",
    )  # fmt: skip
    noise_quantile: float = number(
        0.1, "1", 0.05, 0.5,
        "quantile of the residuals that counts as noise: detail leaves residuals at some "
        "points, noise at all",
    )  # fmt: skip
    clean_residual: float = number(
        0.06, "spacings", 0.0, 0.1,
        "residual that curvature alone causes on clean input",
    )  # fmt: skip

    # Noise (tiles.py, denoise.py)
    noise_tiles: int = number(
        8, "tiles", 1, 64,
        "tiles of a large cloud in which its noise is measured; more cost time before the "
        "first tile",
    )  # fmt: skip
    noise_points: int = number(
        2048, "points", 512, 16384,
        "points of such a tile at which the noise is measured",
    )  # fmt: skip
    noise_threshold: float = number(
        0.1, "spacings", 0.05, 0.3,
        "noise level from which the input is denoised: even validation inputs with 1 % noise "
        "have 0.11 to 0.28, with 2 % 0.2 to 0.4; most without noise have less, some with much"
        " detail up to 0.22",
    )  # fmt: skip
    exact_input_move: float = number(
        0.03, "spacings", 0.01, 0.04,
        "median move under projection up to which the input is exact: 0.002 on clean and even"
        " validation inputs, 0.023 on random ones, 0.04 to 0.18 with 1 % noise",
    )  # fmt: skip

    # Density (geometry/areas.py)
    area_rounds: int = number(
        8, "rounds", 2, 12,
        "rounds of averaging areas over neighbours: the output follows the density of the "
        "input, not its random variation",
    )  # fmt: skip
    even_area: float = number(
        0.06, "log of the ratio to the typical area", 0.0, 0.1,
        "differences of area up to this are treated as random variation of an even input",
    )  # fmt: skip
    uneven_area: float = number(
        0.18, "log of the ratio to the typical area", 0.1, 0.4,
        "differences of area from this on are followed completely",
    )  # fmt: skip
    largest_area: float = number(
        6.0, "times the usual area", 2.0, 16.0,
        "with density even: a chart with a larger area stands beside a gap, not on a surface",
    )  # fmt: skip
    quota_rounds: int = number(
        4, "rounds", 1, 12,
        "rounds of averaging the number of represented points over neighbours",
    )  # fmt: skip

    # Candidates and projection (plan.py, resample/atlas.py, resample/nearest_charts.py, network/)
    oversampling: float = number(
        1.5, "candidates per output point", 1.2, 3.0,
        "more candidates give the elimination more choice and cost projection time",
    )  # fmt: skip
    fewest_candidates: int = number(
        4, "candidates per chart", 2, 8,
        "fewer would leave the elimination no choice at small ratios",
    )  # fmt: skip
    many_candidates: int = number(
        12, "candidates per chart", 8, 48,
        "from this number on (R = 8) candidates are projected onto one chart instead of two: "
        "17 % of the time of projection at R = 16, P2F 0.5 % worse; at R = 4 evenness would "
        "suffer",
    )  # fmt: skip
    blended_charts: int = number(
        3, "charts", 1, 4,
        "charts that are blended at an output point",
    )  # fmt: skip
    searched_charts: int = number(
        12, "charts", 6, 32,
        "charts near a point among which the nearest are searched; more cost time",
    )  # fmt: skip
    blend_falloff: float = number(
        2.0, "per squared spacing", 0.5, 8.0,
        "decrease of the weight of a chart with the squared distance; the weights were "
        "trained with it",
    )  # fmt: skip
    blend_trust: float = number(
        2.0, "1", 0.0, 4.0,
        "power of the inverse expected error in the weight of a chart, 2 for the inverse "
        "variance; the weights were trained with it",
    )  # fmt: skip
    largest_offset: float = number(
        1.25, "spacings", 0.9, 2.0,
        "largest distance of an output point from its input point: the widest holes of an "
        "even scan are 0.85 deep, and a chart extrapolates beyond",
    )  # fmt: skip
    rim_offset: float = number(
        0.5, "spacings", 0.3, 1.25,
        "the same beyond the rim of the scan, where the input lies on one side only",
    )  # fmt: skip
    sure_error: float = number(
        0.03, "spacings", 0.02, 0.1,
        "expected error from which a point of a scan must be nearer to the input; with a smaller "
        "one less is filled",
    )  # fmt: skip
    open_sector: float = number(
        200.0, "degrees", 150.0, 300.0,
        "sector around a point without input from which it is beyond the rim",
    )  # fmt: skip
    other_surface: float = number(
        0.35, "spacings", 0.2, 0.6,
        "mean height of the input around a point above its tangent plane from which the input "
        "belongs to another surface",
    )  # fmt: skip
    isolated_spacing: float = number(
        1.3, "times the spacing around", 1.1, 2.0,
        "largest spacing of a chart that counts, so that an isolated one gets no more room",
    )  # fmt: skip
    averaged_share: float = number(
        0.5, "charts per point", 0.2, 0.8,
        "share below which a cloud counts as averaged: its thickness is then noise, no shadow",
    )  # fmt: skip
    quota_oversampling: float = number(
        2.0, "candidates per output point", 1.5, 3.0,
        "candidates of charts with quotas; fewer leave the elimination no choice",
    )  # fmt: skip
    least_oversampling: float = number(
        1.4, "candidates per output point", 1.1, 2.0,
        "the same where some charts have fewer candidates than their quota asks for",
    )  # fmt: skip
    most_candidates: float = number(
        4.0, "times the candidates of the usual chart", 1.0, 8.0,
        "largest number of candidates per chart: more cost time for few sparse places",
    )  # fmt: skip

    # Elimination (resample/elimination.py after Yuksel 2015, resample/selection.py)
    elimination_neighbours: int = number(
        16, "candidates", 8, 64,
        "neighbours of a candidate that count; more cost time and memory",
    )  # fmt: skip
    weight_limit: float = number(
        0.65, "1", 0.5, 0.8,
        "weight limiting (section 3.2 there): without it the spacing of survivors varies by "
        "11 % instead of 8 %",
    )  # fmt: skip
    weight_limit_power: float = number(
        1.5, "1", 1.0, 2.0,
        "exponent of the weight limiting, as published",
    )  # fmt: skip
    levelling_at: float = number(
        1.3, "times the survivors", 1.1, 2.0,
        "number of remaining candidates at which the weights of dense regions are raised",
    )  # fmt: skip
    levelling_power: int = number(
        6, "1", 0, 8,
        "power of the density of a region by which its weights are raised",
    )  # fmt: skip
    levelling_rounds: int = number(
        2, "rounds", 0, 8,
        "rounds of averaging that density over neighbours",
    )  # fmt: skip
    levelling_bounds: tuple[float, float] = number(
        (0.5, 2.0), "times the mean density", 0.25, 4.0,
        "bounds of that density, so that one sparse or dense chart cannot dominate",
    )  # fmt: skip
    error_penalty: float = number(
        0.1, "weight per usual error", 0.0, 0.5,
        "penalty of a candidate for each usual error by which its expected error exceeds the "
        "limit",
    )  # fmt: skip
    error_rounds: int = number(
        8, "rounds", 2, 16,
        "rounds of averaging expected errors over neighbours to get the usual error: narrow "
        "averages hide unreliable rims",
    )  # fmt: skip
    usual_error: float = number(
        0.85, "times the error around", 0.5, 2.0,
        "errors without a penalty, times R to the power below",
    )  # fmt: skip
    usual_error_power: float = number(
        0.68, "1", 0.0, 1.0,
        "the limit rises with the ratio, since among more points a hole is worse than an "
        "error",
    )  # fmt: skip
    usual_error_least: float = number(
        2.2, "times the error around", 1.5, 3.0,
        "smallest limit; a smaller one leaves holes at R = 2",
    )  # fmt: skip
    usual_error_most: float = number(
        5.6, "times the error around", 4.0, 8.0,
        "largest limit; with a larger one points lie beyond the tips of thin fins",
    )  # fmt: skip
    usual_error_scan: float = number(
        1.6, "times the error around", 1.0, 5.6,
        "largest limit for scans; a smaller one makes points better and their spacing less even",
    )  # fmt: skip
    seed_penalty: float = number(
        1e-05, "weight", 0.0, 0.001,
        "largest random penalty: enough for another sample with each seed, too small to lower"
        " its quality",
    )  # fmt: skip

    # Repulsion (resample/repulsion.py)
    repulsion_rounds: int = number(
        6, "rounds", 0, 12,
        "evenness against time; further rounds change it by less than 1 %",
    )  # fmt: skip
    repulsion_step: float = number(
        0.65, "of the sum of pushes", 0.3, 0.8,
        "six rounds with it equal eight with 0.5; 0.8 is less even",
    )  # fmt: skip
    repulsion_range: float = number(
        1.3, "packing radii", 1.0, 2.0,
        "distance within which survivors push each other",
    )  # fmt: skip
    repulsion_search: float = number(
        1.4, "packing radii", 1.3, 2.0,
        "distance within which neighbours are listed once: the range and the moves of all "
        "rounds",
    )  # fmt: skip
    repulsion_neighbours: int = number(
        14, "survivors", 8, 32,
        "neighbours of a survivor that count; more cost time",
    )  # fmt: skip
    repulsion_strength: float = number(
        0.7, "1", 0.3, 1.0,
        "factor of the push at usual distances",
    )  # fmt: skip
    repulsion_close: float = number(
        0.06, "squared ranges", 0.0, 0.2,
        "increase of the push with the inverse squared distance: otherwise the neighbours of "
        "a close pair keep it together",
    )  # fmt: skip
    repulsion_most: float = number(
        10.0, "1", 1.0, 100.0,
        "largest factor of the push, for points in almost the same place",
    )  # fmt: skip
    repulsion_limit: float = number(
        0.25, "packing radii", 0.1, 0.5,
        "largest move in one round",
    )  # fmt: skip

    # Seams between tiles (resample/seams.py)
    seam_close: float = number(
        0.8, "packing radii", 0.5, 1.0,
        "distance below which points of two tiles are too close; points of one tile rarely "
        "are",
    )  # fmt: skip
    seam_moved: float = number(
        1.5, "packing radii", 1.0, 3.0,
        "distance from such a point within which points are moved",
    )  # fmt: skip
    seam_pushing: float = number(
        3.0, "packing radii", 2.0, 5.0,
        "distance from such a point within which points push",
    )  # fmt: skip
    seam_neighbours: int = number(
        14, "points", 8, 32,
        "neighbours that push a point",
    )  # fmt: skip

    # Orientation (orient/)
    orientation_neighbours: int = number(
        12, "neighbours", 6, 32,
        "input neighbours that share a sign; more cost time and correct little",
    )  # fmt: skip
    orientation_input_edges: int = number(
        6, "neighbours", 3, 12,
        "input neighbours joined last, which connect parts across holes and into the margin",
    )  # fmt: skip
    orientation_members: int = number(
        3, "points per chart", 1, 8,
        "output points of a chart whose signs are optimised; the others take the sign of the "
        "nearest of these",
    )  # fmt: skip
    orientation_complete: float = number(
        5.0, "points per chart", 1.0, 16.0,
        "mean number of output points per chart up to which all signs are optimised",
    )  # fmt: skip
    orientation_range: float = number(
        1.35, "packing radii", 1.0, 2.0,
        "length of edges between output points",
    )  # fmt: skip
    orientation_edges: int = number(
        12, "neighbours", 6, 32,
        "edges of an output point at most",
    )  # fmt: skip
    sure_edges: tuple[float, float] = number(
        (0.003, 0.01), "edge weight", 0.0, 0.03,
        "weights up to which edges are joined without a vote: normals fit one circle to 4 "
        "degrees, then to 8; up to 0.03 costs 2 % of the signs at 2 % noise",
    )  # fmt: skip
    half_vote: float = number(
        0.1, "edge weight", 0.01, 1.0,
        "weight of an edge that has half a vote where two trees disagree",
    )  # fmt: skip
    short_edge: float = number(
        0.6, "of the local mean length", 0.0, 1.0,
        "length below which an edge is less reliable, since noise puts points above each "
        "other: on training shapes with 0 to 1 % noise 94 % of the signs are right instead of"
        " 88 %",
    )  # fmt: skip
    visibility_width: float = number(
        2.0, "spacings", 1.0, 4.0,
        "width of the cells of directions in which the nearest point hides the others from a "
        "station",
    )  # fmt: skip
    visibility_depth: float = number(
        3.0, "spacings", 1.0, 6.0,
        "distance behind the nearest point up to which points in a cell are seen too",
    )  # fmt: skip
    clear_volume: float = number(
        0.05, "of area times radius", 0.01, 0.2,
        "enclosed volume below which a surface counts as open; a closed one has 1/3 or more",
    )  # fmt: skip
    clear_extremes: float = number(
        0.5, "sum of six normal components", 0.1, 2.0,
        "agreement of the outermost normals of an open surface below which it is oriented "
        "upward",
    )  # fmt: skip

    # Tiles (tiles.py)
    margin: float = number(
        6.5, "spacings", 4.0, 8.0,
        "width of the margin: the range of blending and message passing; 4 to 8 made no "
        "difference on validation shapes in tiles of 1,250 points",
    )  # fmt: skip
    charted_margin: float = number(
        3.0, "spacings", 2.0, 6.5,
        "width of the inner margin, whose points get charts; results are unchanged down to 2",
    )  # fmt: skip
    margin_quantile: float = number(
        0.9, "1", 0.5, 1.0,
        "quantile of the spacings of a core that counts as the spacing above, so that sparse "
        "regions have a margin too",
    )  # fmt: skip

    # Attributes (attributes.py)
    attribute_neighbours: int = number(
        3, "points", 1, 8,
        "input points that colours and continuous scalars are interpolated from; more blur "
        "them",
    )  # fmt: skip


TUNING = Tuning()


def table() -> str:
    """Return a Markdown table of all constants."""
    rows = [("name", "value", "unit", "range", "reason"), ("---",) * 5]
    for each in fields(Tuning):
        low, high = each.metadata["range"]
        value = getattr(TUNING, each.name)
        shown = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        reason = each.metadata["reason"]
        rows.append((f"`{each.name}`", shown, each.metadata["unit"], f"{low} to {high}", reason))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


if __name__ == "__main__":
    print(table(), end="")  # noqa: T201 - printing is the purpose of this script
