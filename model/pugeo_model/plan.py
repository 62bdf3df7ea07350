# SPDX-License-Identifier: Apache-2.0
"""The plan of a run: the cleaned and normalised cloud, and its division into tiles."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.attributes import mark_labels
from pugeo_model.clean import clean
from pugeo_model.cloud import Cloud
from pugeo_model.geometry.areas import area_of_spacing, areas_of_quotas, spacing_of_area
from pugeo_model.geometry.neighbours import SPACING_NEIGHBOURS, nearest, spacing
from pugeo_model.geometry.overlapping import patch_count
from pugeo_model.input_points import InputPoints, represent
from pugeo_model.normalise import FEWEST, Normalisation, normalise
from pugeo_model.options import LARGEST_RATIO, Options, refuse
from pugeo_model.orient.given import signs_agree
from pugeo_model.orient.methods import resolve_method
from pugeo_model.orient.stations import (
    directions_to_stations,
    directions_to_visible_stations,
    station_numbers,
)
from pugeo_model.tiles import Tile, TileSpec, plan_tiles
from pugeo_model.tuning import TUNING
from pugeo_model.units import coordinate_warnings

__all__ = ["Plan", "make_plan"]


@dataclass(frozen=True, eq=False)
class Plan:
    """A validated cloud and its tiles.

    Attributes:
        cloud: the cleaned input.
        points: ``(M, 3)`` float64 points of the charts, unit scale.
        input: the input points behind the charts; ``None`` if each has its own chart.
        weights: ``(M,)`` float64 to which the numbers of output points of charts are
            proportional: squared spacings with density ``even``, else numbers of represented
            points; ``None`` if all are equal.
        normalisation: map between the cloud's own frame and the unit frame.
        centroid: ``(3,)`` float64, unit scale.
        tile_specs: rows and sizes of the tiles, see :mod:`pugeo_model.tiles`.
        noise: of the whole cloud, in spacings; ``None`` if the only tile measures it itself.
        spacing: median spacing of the whole cloud, unit scale; ``None`` likewise.
        options: options of the caller.
        orient: the method that gives normals their signs, never ``auto``.
        viewpoint: sensor position in the cloud's own frame and units, if there is one.
        sights: ``(M, 3)`` float32, directions to stations; ``None`` unless several
            stations give the normals their signs.
        usual_weight: weight of the usual chart of the cloud.
        n_out: number of output points.
        report: counts and notes so far, JSON-able.
        patch_ratio: R of a network that upsamples whole patches, ``None`` if charts are predicted.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    input: InputPoints | None
    weights: NDArray[np.float64] | None
    normalisation: Normalisation
    centroid: NDArray[np.float64]
    tile_specs: list[TileSpec]
    noise: float | None
    spacing: float | None
    options: Options
    orient: str
    viewpoint: tuple[float, float, float] | None
    sights: NDArray[np.float32] | None
    usual_weight: float
    n_out: int
    report: dict[str, Any]
    patch_ratio: int | None = None

    @property
    def keeps_input(self) -> bool:
        """True if the output begins with the input points."""
        return self.options.keeps_points(len(self.cloud))

    @property
    def tiles_in_order(self) -> bool:
        """True if the output is the points of the tiles, one after the other."""
        in_order = len(self.tile_specs) == 1 and self.input is None
        return in_order or not self.keeps_input

    def input_rows(self, spec: TileSpec) -> NDArray[np.int32]:
        """Rows of the cleaned cloud behind the core of a tile, in the order of its output."""
        rows = spec.rows[: spec.core]
        return rows if self.input is None else self.input.behind(rows)[0]

    def final_report(self, noise: float) -> dict[str, Any]:
        """Complete the report with the noise level.

        Args:
            noise: measured by the first tile, used if the plan has none; in spacings.
        """
        return {**self.report, "noise": noise if self.noise is None else self.noise}

    @property
    def tiles(self) -> Iterator[Tile]:
        """The tiles, created one at a time during iteration."""
        return map(self.tile, range(len(self.tile_specs)))

    def tile(self, number: int) -> Tile:
        """Return tile ``number`` with its data."""
        spec = self.tile_specs[number]
        whole = len(self.tile_specs) == 1
        source = on_curve = None
        if self.input is not None:
            source = self.input.of_charts(spec.rows, spec.core, self.cloud)
            on_curve = self.input.centres.on_curve[spec.rows]
        cloud = source.cloud if source else self.cloud if whole else self.cloud.take(spec.rows)
        wanted = math.ceil(TUNING.oversampling * self.n_out / len(self.points))
        return Tile(
            cloud=cloud,
            points=self.points if whole else self.points[spec.rows],
            rows=spec.rows,
            core=spec.core,
            charted=spec.charted,
            n_out=spec.n_out,
            candidates=max(TUNING.fewest_candidates, wanted),
            keeps_input=self.keeps_input,
            moves_input=self.options.denoise,
            noise=self.noise,
            spacing=self.spacing,
            normalisation=self.normalisation,
            orient=self.orient,
            viewpoint=None if self.sights is not None else self.viewpoint,
            sights=None if self.sights is None else self.sights[spec.rows],
            centroid=self.centroid,
            seed=self.options.seed,
            patch_ratio=self.patch_ratio,
            is_even=self.options.is_even,
            max_gap=self.options.max_gap and self.options.max_gap / self.normalisation.scale,
            confidence=self.options.confidence,
            input=source,
            weights=None if self.weights is None else self.weights[spec.rows],
            usual_weight=self.usual_weight,
            on_curve=on_curve if on_curve is not None and on_curve.any() else None,
        )


def make_plan(
    cloud: Cloud,
    options: Options,
    tile_size: int | None = None,
    patch_ratio: int | None = None,
) -> Plan:
    """Clean and normalise a cloud, and divide it into tiles.

    Args:
        cloud: the input.
        options: options of the caller.
        tile_size: largest number of input points in the core of a tile; by default it follows
            from the number of output points.
        patch_ratio: ratio R of a network that upsamples whole patches, which is the largest ratio
            then; ``None`` if charts are predicted.

    Raises:
        UntreatableCloudError: the points left after cleaning span no surface.
        BadOptionError: ``n_points`` is not 1 to 32 times the points left, ``spacing`` asks for
            more or for too few, ``orient`` needs normals that the cloud does not have, or the
            network has no charts for an option.
    """
    if patch_ratio is not None:
        _refuse_without_charts(options)
    cleaned, dropped = clean(mark_labels(cloud))
    points, normalisation = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    if n_out is not None:
        _check_points_out(n_out, count, patch_ratio)
    keeps_input = options.keeps_points(count)
    source = None if patch_ratio else represent(points, keep_all=keeps_input)
    if source is not None:
        points = source.centres.points
    weights = _weights(points, source, options)
    if n_out is None:
        n_out = _points_at_spacing(count, weights, normalisation.scale, options)
    kept = None
    if keeps_input:
        kept = np.ones(count, np.int64) if source is None else source.centres.count
    specs, noise, median_spacing = plan_tiles(points, n_out, tile_size, weights, kept)
    may_move = options.denoise or not keeps_input
    if noise is not None and noise > TUNING.noise_threshold and may_move:
        # Denoising moves the margin too, so that core and margin stay consistent: all get charts.
        specs = [replace(spec, charted=len(spec.rows)) for spec in specs]
    cleaned, method = _choose_signs(cleaned, options)
    stations = _stations(cleaned, options) if method == "viewpoint" else None
    sights = None
    if stations is not None and len(stations) > 1:
        sights = _sights(cleaned, points, source, normalisation, stations)
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "charts": len(points),
        "stray": 0 if source is None else int(np.count_nonzero(source.stray)),
        "on_curves": 0 if source is None else int(np.count_nonzero(source.curve)),
        "dropped": {
            "non_finite": dropped.non_finite,
            "wild": dropped.wild,
            "duplicate": dropped.duplicate,
        },
        "patches": sum(
            spec.patches if patch_ratio is None else patch_count(spec.charted) for spec in specs
        ),
        "tiles": len(specs),
        "ratio": n_out / count,
        "orient": method,
        "notes": [*cleaned.notes, *coordinate_warnings(cleaned.points)],
    }
    return Plan(
        cloud=cleaned,
        points=points,
        input=source,
        weights=weights,
        normalisation=normalisation,
        centroid=points.mean(axis=0),
        tile_specs=specs,
        noise=noise,
        spacing=median_spacing,
        options=options,
        orient=method,
        viewpoint=None if stations is None else tuple(stations[0].tolist()),
        sights=sights,
        usual_weight=_usual_weight(weights, options),
        n_out=n_out,
        report=report,
        patch_ratio=patch_ratio,
    )


def _weights(
    points: NDArray[np.float64], source: InputPoints | None, options: Options
) -> NDArray[np.float64] | None:
    """Weights of the charts, see :class:`Plan`."""
    if options.is_even:
        # Squared spacings are areas up to a factor that is the same for all charts.
        return spacing(nearest(points, SPACING_NEIGHBOURS)[0]).astype(np.float64) ** 2
    return None if source is None else source.centres.count.astype(np.float64)


def _usual_weight(weights: NDArray[np.float64] | None, options: Options) -> float:
    """Weight of the usual chart: the median of areas, which gaps do not change, or the mean."""
    if weights is None:
        return 1.0
    return float(np.median(weights) if options.is_even else weights.mean())


def _check_points_out(n_out: int, count: int, patch_ratio: int | None) -> None:
    """Refuse a number of output points that is not 1 to 32 times the points left after cleaning.

    Raises:
        BadOptionError: ``n_points`` is too small or too large.
    """
    largest = int(LARGEST_RATIO) if patch_ratio is None else patch_ratio
    most = largest * count
    if not count <= n_out <= most:
        refuse(
            "n_points",
            n_out,
            f"from {count} to {most} (1 to {largest} times the points left after cleaning)",
            limit=[count, most],
        )


def _points_at_spacing(
    count: int, weights: NDArray[np.float64] | None, scale: float, options: Options
) -> int:
    """Number of output points by the spacing that is asked for.

    Raises:
        BadOptionError: that are fewer than 8 points, or more than 32 times the input.
    """
    assert weights is not None
    assert options.spacing is not None
    most = int(LARGEST_RATIO) * count
    area = float(areas_of_quotas(weights, 1.0).sum())
    finest = spacing_of_area(area / most) * scale
    coarsest = spacing_of_area(area / FEWEST) * scale
    if not finest <= options.spacing <= coarsest:
        refuse(
            "spacing",
            options.spacing,
            f"from {finest:.4g} to {coarsest:.4g} for this cloud: {most} to {FEWEST} points",
            limit=[finest, coarsest],
        )
    return round(area / area_of_spacing(options.spacing / scale))


def _refuse_without_charts(options: Options) -> None:
    """Refuse options that need charts, for a network that upsamples whole patches."""
    if options.is_even:
        name = "density" if options.spacing is None else "spacing"
    elif options.max_gap is not None:
        name = "max_gap"
    elif options.denoise:
        name = "denoise"
    elif options.confidence:
        name = "confidence"
    else:
        return
    refuse(name, getattr(options, name), "left out: this network upsamples whole patches")


def _stations(cloud: Cloud, options: Options) -> NDArray[np.float64] | None:
    """Sensor positions ``(k, 3)`` in the cloud's own frame; those of the caller count first."""
    if options.viewpoints:
        return np.array(options.viewpoints, dtype=np.float64)
    return cloud.viewpoints


def _sights(
    cloud: Cloud,
    points: NDArray[np.float64],
    source: InputPoints | None,
    normalisation: Normalisation,
    stations: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Directions from the charts to the stations that saw them, ``(M, 3)``."""
    places = normalisation.unit(stations)
    number = station_numbers(cloud, len(stations))
    if number is None:
        typical = float(np.median(spacing(nearest(points, SPACING_NEIGHBOURS)[0])))
        return directions_to_visible_stations(points, places, typical)
    if source is None:
        return directions_to_stations(points, places, number)
    return source.sums_of_charts(directions_to_stations(source.points, places, number))


def _choose_signs(cloud: Cloud, options: Options) -> tuple[Cloud, str]:
    """Choose the method that gives normals their signs, with a note where the input misleads.

    ``auto`` means the input's normals if their signs agree, else a viewpoint if there is one.
    """
    given = cloud.normals is not None
    viewpoint = _stations(cloud, options)
    method = resolve_method(options.orient, viewpoint, has_normals=given)
    if method != "input" or signs_agree(cloud):
        return cloud, method
    note = "The input's normals have random signs: neighbours often point to opposite sides."
    if options.orient == "auto":
        method = resolve_method("auto", viewpoint, has_normals=False)
        note += f" The signs come from {method!r} instead."
    return replace(cloud, notes=(*cloud.notes, note)), method
