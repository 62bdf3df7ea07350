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
from pugeo_model.geometry.overlapping import patch_count
from pugeo_model.normalise import Normalisation, normalise
from pugeo_model.options import LARGEST_RATIO, Options, refuse
from pugeo_model.orient.given import signs_agree
from pugeo_model.orient.methods import resolve_method
from pugeo_model.tiles import Tile, TileSpec, plan_tiles
from pugeo_model.tuning import TUNING
from pugeo_model.units import coordinate_warnings

__all__ = ["Plan", "make_plan"]


@dataclass(frozen=True, eq=False)
class Plan:
    """A validated cloud and its tiles.

    Attributes:
        cloud: the cleaned input.
        points: ``(M, 3)`` float64, unit scale.
        normalisation: map between the cloud's own frame and the unit frame.
        centroid: ``(3,)`` float64, unit scale.
        tile_specs: rows and sizes of the tiles, see :mod:`pugeo_model.tiles`.
        noise: of the whole cloud, in spacings; ``None`` if the only tile measures it itself.
        spacing: median spacing of the whole cloud, unit scale; ``None`` likewise.
        options: options of the caller.
        orient: the method that gives normals their signs, never ``auto``.
        n_out: number of output points.
        report: counts and notes so far, JSON-able.
        patch_ratio: R of a network that upsamples whole patches, ``None`` if charts are predicted.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    normalisation: Normalisation
    centroid: NDArray[np.float64]
    tile_specs: list[TileSpec]
    noise: float | None
    spacing: float | None
    options: Options
    orient: str
    n_out: int
    report: dict[str, Any]
    patch_ratio: int | None = None

    @property
    def keeps_input(self) -> bool:
        """True if the output begins with the input points."""
        return self.options.keeps_points(len(self.points))

    @property
    def tiles_in_order(self) -> bool:
        """True if the output is the points of the tiles, one after the other."""
        return len(self.tile_specs) == 1 or not self.keeps_input

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
        wanted = math.ceil(TUNING.oversampling * self.n_out / len(self.points))
        return Tile(
            cloud=self.cloud if whole else self.cloud.take(spec.rows),
            points=self.points if whole else self.points[spec.rows],
            rows=spec.rows,
            core=spec.core,
            charted=spec.charted,
            n_out=spec.n_out,
            candidates=max(TUNING.fewest_candidates, wanted),
            keeps_input=self.keeps_input,
            noise=self.noise,
            spacing=self.spacing,
            normalisation=self.normalisation,
            orient=self.orient,
            viewpoint=self.options.viewpoint,
            centroid=self.centroid,
            seed=self.options.seed,
            patch_ratio=self.patch_ratio,
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
        BadOptionError: ``n_points`` is not 1 to 32 times the points left, or ``orient`` needs
            normals that the cloud does not have.
    """
    cleaned, dropped = clean(mark_labels(cloud))
    points, normalisation = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    largest = int(LARGEST_RATIO) if patch_ratio is None else patch_ratio
    most = largest * count
    if not count <= n_out <= most:
        refuse(
            "n_points",
            n_out,
            f"from {count} to {most} (1 to {largest} times the points left after cleaning)",
            limit=[count, most],
        )
    specs, noise, median_spacing = plan_tiles(points, n_out, tile_size)
    if noise is not None and noise > TUNING.noise_threshold and not options.keeps_points(count):
        # Denoising moves the margin too, so that core and margin stay consistent: all get charts.
        specs = [replace(spec, charted=len(spec.rows)) for spec in specs]
    cleaned, method = _choose_signs(cleaned, options)
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "dropped": {"non_finite": dropped.non_finite, "duplicate": dropped.duplicate},
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
        normalisation=normalisation,
        centroid=points.mean(axis=0),
        tile_specs=specs,
        noise=noise,
        spacing=median_spacing,
        options=options,
        orient=method,
        n_out=n_out,
        report=report,
        patch_ratio=patch_ratio,
    )


def _choose_signs(cloud: Cloud, options: Options) -> tuple[Cloud, str]:
    """Choose the method that gives normals their signs, with a note where the input misleads.

    ``auto`` means the input's normals if their signs agree, else a viewpoint if there is one.
    """
    given = cloud.normals is not None
    viewpoint = cloud.viewpoints if options.viewpoint is None else options.viewpoint
    method = resolve_method(options.orient, viewpoint, has_normals=given)
    if method != "input" or signs_agree(cloud):
        return cloud, method
    note = "The input's normals have random signs: neighbours often point to opposite sides."
    if options.orient == "auto":
        method = resolve_method("auto", viewpoint, has_normals=False)
        note += f" The signs come from {method!r} instead."
    return replace(cloud, notes=(*cloud.notes, note)), method
