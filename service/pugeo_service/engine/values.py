# SPDX-License-Identifier: Apache-2.0
"""What stays on the workers between the steps of a request.

Everything of the model's is ``Any``: the front reads these types and must not import what they
are made of.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Agreed", "Carried", "Charted", "Finished", "Prepared", "TileSpec", "Written"]


@dataclass(frozen=True)
class Carried:
    """A value of the model's as the whole result of a stage.

    Dask's client in the front looks up the type of each result: of the model's own it would import
    the module, and scipy and numba with it.
    """

    value: Any


@dataclass(frozen=True)
class Prepared:
    """A cloud that was read, or a tile of one.

    Attributes:
        plan: how the cloud is cut; ``None`` for a tile.
        job: the tile, or the cloud where it is in one piece; ``None`` where it is not.
        seconds: of each stage so far.
        by_rows: the answer can be written tile by tile.
        written: the answer, where the cloud was small enough to be done at once.
        batches: seconds and patches that the network took for a noisy cloud, before it was prepared
            anew.
    """

    plan: Any
    job: Any
    seconds: dict[str, float]
    by_rows: bool = False
    written: "Written | None" = None
    batches: list[tuple[float, int]] = field(default_factory=list)


@dataclass(frozen=True)
class TileSpec:
    """Some of the patches of a job."""

    patches: list[Any]
    candidates: int


@dataclass(frozen=True)
class Charted:
    """Patches that went through the network."""

    charts: list[Any]
    seconds: float


@dataclass(frozen=True)
class Finished:
    """The dense points of a tile.

    Attributes:
        piece: the points.
        seconds: of each stage since the network.
        batches: seconds and patches that the network took for it.
    """

    piece: Any
    seconds: dict[str, float]
    batches: list[tuple[float, int]]


@dataclass(frozen=True)
class Agreed:
    """What the tiles of a cloud need to know before they can be written one by one.

    Attributes:
        tiles: what each of them was told.
        count: points of the whole answer.
        answer: its format.
        report: what happened.
        seconds: that it took.
    """

    tiles: list[Any]
    count: int
    answer: str
    report: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class Written:
    """Bytes of the answer, uint8: all, or those of a tile.

    Attributes:
        data: the bytes.
        report: what happened.
        seconds: of each stage that nobody was told of yet.
        batches: seconds and patches that the network took, likewise.
    """

    data: NDArray[np.uint8]
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: list[tuple[float, int]] = field(default_factory=list)
