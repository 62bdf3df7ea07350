# SPDX-License-Identifier: Apache-2.0
"""What goes into the engine and what comes out of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pugeo_service.storage.spool import Spool

__all__ = ["Head", "InMemory", "Order", "Outcome", "Readable", "Sheet", "Watcher"]

# A patch has 2048 points of its own. A point takes 12 bytes at least, as text three times as many.
_BYTES_PER_PATCH = 2048 * 12
_TEXT = 3
_TEXTS = frozenset({"json", "xyz"})


@dataclass(frozen=True)
class Order:
    """A request as the workers see it: plain values, no model, no open file.

    Attributes:
        model: name or path of the weights.
        format: the input's format, or ``None`` where the content decides.
        answer: format of the answer.
        options: keyword arguments of the model's ``Options``.
        max_points: bound on the points of the input.
        max_output_points: bound on the points of the answer.
        batch_patches: bound on the patches of one task.
        deadline_s: seconds the whole may take.
        background: whoever waits for an answer goes first.
        at_once_patches: a cloud of so many patches is done in one task.
    """

    model: str
    format: str | None
    answer: str
    options: dict[str, Any]
    max_points: int
    max_output_points: int
    batch_patches: int
    deadline_s: float
    background: bool = False
    at_once_patches: int = 1

    @staticmethod
    def estimate(size: int, format: str | None) -> int:
        """Return a guess (>= 1) at the patches in a body of ``size`` bytes, before it is read."""
        return max(1, size // (_BYTES_PER_PATCH * (_TEXT if format in _TEXTS else 1)))


@dataclass(frozen=True)
class Head:
    """What the front learns once a cloud is prepared.

    Attributes:
        patches: units of work.
        tiles: parts that go their way one by one; most clouds are one.
        seconds: time of each stage so far.
        by_rows: the answer can be written tile by tile.
        sheet: of the answer, where the cloud was so small that it is done already.
        batches: seconds and patches that the network took for what is predicted once more.
        noisy: it is to be denoised. Said of what was: its points were right, its charts still hold.
    """

    patches: int
    tiles: int
    seconds: dict[str, float]
    by_rows: bool = False
    sheet: "Sheet | None" = None
    batches: Sequence[tuple[float, int]] = ()
    noisy: bool = False


@dataclass(frozen=True)
class Sheet:
    """What the front learns once an answer, or a part of one, is written.

    Attributes:
        size: how many bytes it has.
        first: those of them that came along, or how many are in the front's file already.
        report: the model's report of the run.
        seconds: time of each stage on the workers.
        batches: seconds and patches that the network took.
    """

    size: int
    first: bytes | int
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: Sequence[tuple[float, int]] = ()

    @property
    def whole(self) -> bool:
        """Whether all bytes came along."""
        came = self.first if isinstance(self.first, int) else len(self.first)
        return came == self.size


@dataclass(frozen=True)
class Outcome:
    """An answer, whole, in the hands of the front.

    Attributes:
        spool: the bytes; whoever holds the outcome closes it.
        report: the model's report of the run.
        seconds: wall time of each stage, in order; ``queue`` is the time waited. Of a cloud in
            tiles it is the sum over tiles, several of which run side by side.
        batches: seconds and patches of each batch that the network ran.
    """

    spool: Spool
    report: dict[str, Any]
    seconds: dict[str, float]
    batches: list[tuple[float, int]]


class Readable(Protocol):
    """Bytes that the engine asks for when it begins, and again where it begins anew.

    Attributes:
        size: how many.
    """

    size: int

    async def read(self) -> NDArray[np.uint8]:
        """Return all bytes, uint8 ``(size,)``."""


class InMemory:
    """Bytes that are here already.

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
class Watcher:
    """Who is told how far a request is; called from the engine's thread.

    Attributes:
        on_patches: the number of patches became known.
        on_done: that many patches more went through the network.
        on_stage: the next stage begins.
    """

    on_patches: Callable[[int], object] = field(default=_ignore)
    on_done: Callable[[int], object] = field(default=_ignore)
    on_stage: Callable[[str], object] = field(default=_ignore)
