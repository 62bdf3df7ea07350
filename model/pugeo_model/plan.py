# SPDX-License-Identifier: Apache-2.0
"""The plan of a run: the cleaned, normalised cloud and the tiles that it is cut into."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.attributes import mark_labels
from pugeo_model.clean import clean
from pugeo_model.cloud import Cloud
from pugeo_model.normalise import Normalisation, normalise
from pugeo_model.options import MOST, Options, refuse
from pugeo_model.orient.given import signs_agree
from pugeo_model.orient.methods import resolve_method
from pugeo_model.tiles import Tile, TileSpec, plan_tiles
from pugeo_model.tuning import TUNING
from pugeo_model.units import coordinate_warnings

__all__ = ["Plan", "make_plan"]


@dataclass(frozen=True, eq=False)
class Plan:
    """A cloud that is known to be usable, and its tiles.

    Attributes:
        cloud: the cleaned input.
        points: ``(M, 3)`` float64, unit scale.
        normalisation: offset and scale taken out.
        centroid: ``(3,)``, unit scale.
        tile_specs: rows and sizes of the tiles, see :mod:`pugeo_model.tiles`.
        noise, spacing: of the whole cloud, ``None`` where its only tile measures them.
        options: as asked for.
        orient: the method that gives normals their signs, never ``auto``.
        n_out: points of the answer.
        report: counts and notes so far, JSON-able.
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

    @property
    def keeps_input(self) -> bool:
        """Whether the answer begins with the input points."""
        return self.options.keeps_points(len(self.points))

    @property
    def tiles_in_order(self) -> bool:
        """Whether the answer is the tiles' points one after the other."""
        return len(self.tile_specs) == 1 or not self.keeps_input

    def final_report(self, noise: float) -> dict[str, Any]:
        """The report, with ``noise`` where a single tile measured it."""
        return {**self.report, "noise": noise if self.noise is None else self.noise}

    @property
    def tiles(self) -> Iterator[Tile]:
        """The tiles, each made when its turn comes."""
        return map(self.tile, range(len(self.tile_specs)))

    def tile(self, number: int) -> Tile:
        """Return a tile with all data that it needs."""
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
        )


def make_plan(cloud: Cloud, options: Options, tile_size: int | None = None) -> Plan:
    """Clean and normalise a cloud, and cut it into tiles.

    Args:
        cloud: the input.
        options: of the caller.
        tile_size: input points of a tile at most; chosen by the size of its answer if ``None``.

    Raises:
        UntreatableCloudError: the points left after cleaning span no surface.
        BadOptionError: ``n_points`` is not 1 to 32 times the points left, or ``orient`` asks for
            data that the cloud does not have.
    """
    cleaned, dropped = clean(mark_labels(cloud))
    points, normalisation = normalise(cleaned.points)
    count = len(points)
    n_out = options.points_out(count)
    if not count <= n_out <= MOST * count:
        refuse(
            "n_points",
            n_out,
            f"from {count} to {int(MOST) * count} (1 to 32 times the points left after cleaning)",
            limit=[count, int(MOST) * count],
        )
    specs, noise, typical = plan_tiles(points, n_out, tile_size)
    if noise is not None and noise > TUNING.noisy and not options.keeps_points(count):
        # Points of the core lean on those of the margin, so the margin is denoised as well.
        specs = [replace(spec, charted=len(spec.rows)) for spec in specs]
    cleaned, method = _choose_signs(cleaned, options)
    report = {
        "points_in": len(cloud),
        "points_used": count,
        "points_out": n_out,
        "dropped": {"non_finite": dropped.non_finite, "duplicate": dropped.duplicate},
        "patches": sum(spec.patches for spec in specs),
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
        spacing=typical,
        options=options,
        orient=method,
        n_out=n_out,
        report=report,
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
