# SPDX-License-Identifier: Apache-2.0
"""What a cloud is between the stages of its way: a plan, jobs, pieces, the result."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.finish.joining import Sides
from pugeo_model.finish.seams import Rim
from pugeo_model.geometry.frames import Frames
from pugeo_model.normalise import Placement
from pugeo_model.options import Options
from pugeo_model.tiles import Cut, Tile

__all__ = ["Agreed", "Border", "Job", "Piece", "Plan", "Result"]

_OVERSAMPLE = 1.5  # candidates a point wanted
_FEWEST_CANDIDATES = 4  # a chart: fewer would leave elimination no choice at small ratios


@dataclass(frozen=True, eq=False)
class Plan:
    """A cloud that is known to be usable, and how it is cut.

    Attributes:
        cloud: the cleaned input.
        points: ``(M, 3)`` float64, unit scale.
        placement: offset and scale taken out.
        centroid: ``(3,)``, unit scale.
        cuts: the tiles, see :mod:`pugeo_model.tiles`.
        noise, spacing: of the whole cloud, ``None`` where the only tile finds out by itself.
        options: as asked for.
        orient: the method that gives normals their signs, never ``auto``.
        n_out: points of the answer.
        report: what happened, JSON-able.
        patch_ratio: R of a network that upsamples whole patches, ``None`` where charts are
            predicted.
    """

    cloud: Cloud
    points: NDArray[np.float64]
    placement: Placement
    centroid: NDArray[np.float64]
    cuts: list[Cut]
    noise: float | None
    spacing: float | None
    options: Options
    orient: str
    n_out: int
    report: dict[str, Any]
    patch_ratio: int | None = None

    @property
    def keeps_input(self) -> bool:
        """Whether the answer begins with the input points."""
        return self.options.keeps_points(len(self.points))

    @property
    def tiles_in_order(self) -> bool:
        """Whether the answer is the tiles' points one after the other."""
        return len(self.cuts) == 1 or not self.keeps_input

    def told(self, noise: float) -> dict[str, Any]:
        """The report, with the noise of a cloud in one piece."""
        return {**self.report, "noise": noise if self.noise is None else self.noise}

    @property
    def tiles(self) -> Iterator[Tile]:
        """The tiles, each made when its turn comes."""
        return map(self.tile, range(len(self.cuts)))

    def tile(self, number: int) -> Tile:
        """Return a tile with all that it needs on its way."""
        cut = self.cuts[number]
        whole = len(self.cuts) == 1
        wanted = math.ceil(_OVERSAMPLE * self.n_out / len(self.points))
        return Tile(
            cloud=self.cloud if whole else self.cloud.take(cut.rows),
            points=self.points if whole else self.points[cut.rows],
            rows=cut.rows,
            core=cut.core,
            charted=cut.charted,
            n_out=cut.n_out,
            candidates=max(_FEWEST_CANDIDATES, wanted),
            keeps_input=self.keeps_input,
            noise=self.noise,
            spacing=self.spacing,
            placement=self.placement,
            orient=self.orient,
            viewpoint=self.options.viewpoint,
            centroid=self.centroid,
            seed=self.options.seed,
            patch_ratio=self.patch_ratio,
        )


@dataclass(frozen=True, eq=False)
class Job:
    """A prepared tile.

    Attributes:
        tile: what it was made of.
        cloud: its input points, rows in the order of the patches.
        order: ``(M,)`` int32, the row of the tile that each is.
        core: ``(M,)`` which of them are the core's.
        points: ``(M, 3)`` float64, unit scale.
        neighbours: ``(M, 32)`` int32, nearest first.
        frames: one a point.
        share: ``(M,)`` area that each stands for, see :mod:`~pugeo_model.geometry.shares`.
        patches: the units of work: each a ``Patch``, whose cores partition the points that get
            charts, or an overlapping ``PointPatch`` of networks that upsample whole patches.
        noise: of the input as it came, see `noise_level`.
        denoised: the points are where those of a noisy input landed.
    """

    tile: Tile
    cloud: Cloud
    order: NDArray[np.int32]
    core: NDArray[np.bool_]
    points: NDArray[np.float64]
    neighbours: NDArray[np.int32]
    frames: Frames
    share: NDArray[np.float64]
    patches: list[Any]
    noise: float
    denoised: bool = False

    @property
    def candidates(self) -> int:
        """Candidates a chart."""
        return self.tile.candidates

    @property
    def nothing_new(self) -> bool:
        """Whether the answer is the input points, with normals."""
        return self.tile.keeps_input and self.tile.n_out == self.tile.core


@dataclass(frozen=True, eq=False)
class Border:
    """What tiles have to know of each other: little, so that only it travels.

    Attributes:
        sides: what the tile knows of the signs of its normals, ``None`` where these are final.
        rim: the points next to other tiles, ``None`` of a cloud in one piece.
    """

    sides: Sides | None
    rim: Rim | None


@dataclass(frozen=True, eq=False)
class Piece:
    """The dense points of a tile's core.

    Attributes:
        cloud: in the cloud's own frame and units.
        parts: ``(K,)`` connected part of the tile that each lies on; ``None`` where the normals'
            signs are final.
        border: what the other tiles have to know of it.
        noise: of its input, see `noise_level`.
        placement: of the cloud.
    """

    cloud: Cloud
    parts: NDArray[np.integer[Any]] | None
    border: Border
    noise: float
    placement: Placement


@dataclass(frozen=True, eq=False)
class Agreed:
    """What a tile is told once all know of each other.

    Attributes:
        signs: of its parts, ``None`` where its normals are final.
        rim: ``(k, 3)`` where the points of its rim lie, unit scale; ``None`` where they stay.
    """

    signs: NDArray[np.float64] | None
    rim: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Result:
    """The dense cloud and the report on its making."""

    cloud: Cloud
    report: dict[str, Any]
