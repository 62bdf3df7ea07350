# SPDX-License-Identifier: Apache-2.0
"""Messages between the front and the engine, and between the engine and its workers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.spool import Spool

__all__ = [
    "AgreementInfo",
    "BodyReader",
    "DenseInfo",
    "InMemory",
    "ModelId",
    "OutputInfo",
    "PreparedInfo",
    "ProgressCallbacks",
    "RunRequest",
    "RunResult",
]

# A patch has 2,048 points of its own. A point takes at least 12 bytes, as text three times as many.
_BYTES_PER_PATCH = 2048 * 12
_TEXT_FACTOR = 3
_TEXT_FORMATS = frozenset({"json", "xyz"})


@dataclass(frozen=True)
class ModelId:
    """Weights by their name, or path, and their sha256."""

    name: str
    sha256: str


@dataclass(frozen=True)
class RunRequest:
    """A request as the workers see it: plain values, no model, no open file.

    Attributes:
        model: weights to use.
        format: format of the input, or ``None`` if the content decides.
        answer: format of the answer.
        options: keyword arguments of the model's ``Options``.
        max_points: bound on the points of the input.
        max_output_points: bound on the points of the answer.
        max_cloud_bytes: bound on the bytes of the input's points with all attributes.
        max_output_bytes: the same of the answer.
        deadline_s: seconds the whole may take.
        background: no client waits on a connection, so other requests have priority.
        one_task_patches: a cloud of at most so many patches is upsampled in one task.
        worker_bytes: memory of a worker, ``None`` if it is unlimited or unknown.
        surface_points: the answer is a mesh, reconstructed from at most so many points; ``None``:
            it is the dense cloud.
    """

    model: ModelId
    format: str | None
    answer: str
    options: dict[str, Any]
    max_points: int
    max_output_points: int
    max_cloud_bytes: int
    max_output_bytes: int
    deadline_s: float
    background: bool = False
    one_task_patches: int = 1
    worker_bytes: int | None = None
    surface_points: int | None = None

    @staticmethod
    def estimate(size: int, format: str | None) -> int:
        """Estimate the patches (>= 1) in a body of ``size`` bytes before it is read."""
        return max(1, size // (_BYTES_PER_PATCH * (_TEXT_FACTOR if format in _TEXT_FORMATS else 1)))


@dataclass(frozen=True)
class OutputInfo:
    """Description of bytes of an answer.

    Attributes:
        size: number of bytes.
        first: the first bytes, or the number of bytes that are in the front's file already.
        report: of the run.
        seconds: of each stage that was not reported yet.
        batches: seconds and patches of each run through the network, likewise.
    """

    size: int
    first: bytes | int
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: Sequence[tuple[float, int]] = ()


@dataclass(frozen=True)
class PreparedInfo:
    """Description of a planned cloud or a prepared tile.

    Attributes:
        patches: units of work.
        tiles: number of tiles; most clouds are one.
        seconds: of each stage so far.
        by_rows: whether the answer can be written tile by tile.
        output: description of the answer if the cloud was upsampled already.
        noisy: whether the tile needs denoising.
    """

    patches: int
    tiles: int
    seconds: dict[str, float]
    by_rows: bool = False
    output: OutputInfo | None = None
    noisy: bool = False


@dataclass(frozen=True)
class DenseInfo:
    """Description of a dense tile: seconds of stages, seconds and patches of batches."""

    seconds: dict[str, float]
    batches: Sequence[tuple[float, int]]


@dataclass(frozen=True)
class AgreementInfo:
    """Description of the agreement of all tiles: report of the run, seconds of stages."""

    report: dict[str, Any]
    seconds: dict[str, float]


@dataclass(frozen=True)
class RunResult:
    """A whole answer on the disk or in the memory of the front.

    Attributes:
        spool: the bytes; the holder of the result closes it.
        report: of the run.
        seconds: wall time of each stage, in order; ``queue`` is the time waited. Of a cloud in
            tiles it is the sum over tiles, several of which run side by side.
        batches: seconds and patches of each run through the network.
    """

    spool: Spool
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: list[tuple[float, int]]


class BodyReader(Protocol):
    """Bytes of a body that the engine reads when a run begins, and again if it is repeated.

    Attributes:
        size: number of bytes.
    """

    size: int

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``."""


class InMemory:
    """A body in memory.

    Args:
        data: uint8 ``(size,)``.
    """

    def __init__(self, data: NDArray[np.uint8]) -> None:
        self._data = data
        self.size = len(data)

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes."""
        return self._data


def _ignore(*_: object) -> None:
    return None


@dataclass(frozen=True)
class ProgressCallbacks:
    """Functions that are told the progress of a run; called in the engine's thread.

    Attributes:
        on_patches: called with the number of patches once it is known.
        on_done: called with a number of further patches that went through the network.
        on_stage: called with the name of a stage that begins.
    """

    on_patches: Callable[[int], object] = field(default=_ignore)
    on_done: Callable[[int], object] = field(default=_ignore)
    on_stage: Callable[[str], object] = field(default=_ignore)
