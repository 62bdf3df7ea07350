# SPDX-License-Identifier: Apache-2.0
"""Values that stay on the workers between the stages of a request.

The front reads these types and must load neither torch nor numba, so the model's types are
imported for type checking only.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pugeo_model.assembly import Agreement
    from pugeo_model.finish import UpsampledTile
    from pugeo_model.geometry.overlapping import PointPatch
    from pugeo_model.geometry.patches import Patch
    from pugeo_model.local_stages import Predicted
    from pugeo_model.plan import Plan
    from pugeo_model.prepare import PreparedTile

__all__ = [
    "Batches",
    "DenseTile",
    "Opaque",
    "Output",
    "PatchBatch",
    "PredictedBatch",
    "Prepared",
    "TileAgreements",
]

T = TypeVar("T")

Batches = list[tuple[float, int]]
"""Seconds and number of patches of each run through the network."""


@dataclass(frozen=True)
class Opaque(Generic[T]):
    """A value of the model as the whole result of a stage.

    Dask's client in the front imports the type of each result: the model's own types would bring
    scipy and numba along.
    """

    value: T


@dataclass(frozen=True)
class Prepared:
    """A cloud that was read and planned, or one tile of a cloud, prepared.

    Attributes:
        plan: tiles of the cloud; ``None`` of a tile.
        tile: the tile, or the cloud if it has one tile; ``None`` for several tiles.
        seconds: of each stage so far.
        by_rows: whether the answer can be written tile by tile.
        output: the answer if the cloud was small enough for one task.
    """

    plan: Plan | None
    tile: PreparedTile | None
    seconds: dict[str, float]
    by_rows: bool = False
    output: Output | None = None


@dataclass(frozen=True)
class PatchBatch:
    """Some patches of a tile, and the candidates wanted from each chart."""

    patches: list[Patch] | list[PointPatch]
    candidates: int


@dataclass(frozen=True)
class PredictedBatch:
    """Charts of some patches, and the seconds that the network took for them."""

    charts: list[Predicted]
    seconds: float


@dataclass(frozen=True)
class DenseTile:
    """The dense points of a tile.

    Attributes:
        tile: the points.
        seconds: of each stage since the network.
        batches: of the network.
    """

    tile: UpsampledTile
    seconds: dict[str, float]
    batches: Batches


@dataclass(frozen=True)
class TileAgreements:
    """Everything that tiles need to be written one by one.

    Attributes:
        tiles: the agreement of each tile.
        count: points of the whole answer.
        format: of the answer.
        report: of the run.
        seconds: that agreeing took.
    """

    tiles: list[Agreement]
    count: int
    format: str
    report: dict[str, Any]
    seconds: dict[str, float]


@dataclass(frozen=True)
class Output:
    """Bytes of the answer, uint8: all, or those of a tile.

    Attributes:
        data: the bytes.
        report: of the run.
        seconds: of each stage that was not reported yet.
        batches: of the network, likewise.
    """

    data: NDArray[np.uint8]
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: Batches = field(default_factory=list)
