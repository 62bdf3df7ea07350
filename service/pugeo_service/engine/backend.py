# SPDX-License-Identifier: Apache-2.0
"""What the engine needs of whatever runs its tasks."""

from collections.abc import Iterable
from typing import Any, Literal, Protocol

__all__ = ["CORE", "QUICK", "Pool", "Stage"]

# Functions of `stages`, by name: the front must not import what they need.
Stage = Literal[
    "prepare",
    "describe_prepared",
    "cut_tile",
    "prepare_tile",
    "cut_patches",
    "predict",
    "predict_part",
    "denoise",
    "finish",
    "finish_tile",
    "describe_finished",
    "border",
    "agree",
    "describe_agreed",
    "write_tile",
    "assemble",
    "at_once",
    "describe_written",
    "chunk",
]

QUICK: frozenset[Stage] = frozenset(
    {
        "describe_prepared",
        "describe_finished",
        "describe_agreed",
        "describe_written",
        "cut_tile",
        "cut_patches",
        "border",
        "at_once",
        "chunk",
    }
)
"""Stages that only look something up or copy it: they run beside a worker's other stages, and wait
for none of them."""

CORE = "core"
"""What a worker has one of and all other stages need: they run one at a time."""


class Pool(Protocol):
    """Runs stages on workers. Everything happens in the engine's own event loop."""

    async def start(self) -> None:
        """Start the workers, or reach those that run elsewhere, and wait until one is warm."""

    async def stop(self) -> None:
        """End what was started."""

    @property
    def warm_workers(self) -> int:
        """Workers that could run a task now."""

    @property
    def places(self) -> tuple[str, ...]:
        """Their names, for ``submit``."""

    @property
    def lost_workers(self) -> int:
        """Workers that ended without being told to, since the start."""

    @property
    def retried_patches(self) -> int:
        """Patches whose task began once more because a worker was lost, since the start."""

    def submit(
        self,
        stage: Stage,
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        place: str | None = None,
    ) -> Any:
        """Queue ``stage(*args)`` and return a handle of its result, which stays on a worker.

        Args:
            stage: name of a function of ``stages``.
            args: values, handles, or lists of handles.
            priority: larger runs earlier.
            seconds: a worker that takes longer is ended.
            long: the stage takes seconds and not milliseconds, as the pool could not know.
            patches: how many patches the task runs through the network.
            place: the worker to run it as long as there is one of that name; any if ``None``.
        """

    async def wait(self, handle: Any) -> None:
        """Wait for a result without moving it.

        Raises:
            WorkerLostError: it ended two workers.
            EngineLostError: the scheduler forgot it.
            Exception: what the stage raised.
        """

    async def fetch(self, handle: Any) -> Any:
        """Wait for a result and bring it here; raises what ``wait`` raises."""

    def release(self, handles: Iterable[Any]) -> None:
        """Let results go that nothing but tasks already submitted needs."""

    def cancel(self, handles: Iterable[Any]) -> None:
        """Let results go, and drop whatever has not begun yet."""
