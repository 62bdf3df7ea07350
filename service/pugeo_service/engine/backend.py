# SPDX-License-Identifier: Apache-2.0
"""Interface of backends, which run the tasks of the engine."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from pugeo_service import __version__
from pugeo_service.observability.telemetry import WorkerUse

if TYPE_CHECKING:
    from pugeo_model.weights import Weights

__all__ = ["CORE", "QUICK", "QUICK_PREFIX", "Backend", "Handle", "is_quick", "quick"]

CORE = f"core-{__version__}"
"""Dask resource of which a worker has one: stages that compute need it, so they run one by one.

It is named after the version, so that workers of another version are given no task.
"""
QUICK_PREFIX = "quick-"
QUICK = f"{QUICK_PREFIX}{__version__}"
"""Dask resource of stages that only look something up: it chooses workers and is never used up."""

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
StageT = TypeVar("StageT", bound=Callable[..., Any])


class Handle(Protocol[T_co]):
    """The result of a task, which stays on a worker; a backend decides what it really is."""


_QUICK: set[Callable[..., Any]] = set()


def quick(stage: StageT) -> StageT:
    """Mark a stage that only looks something up or copies it.

    Quick stages run beside a worker's other stages and wait for none of them.
    """
    _QUICK.add(stage)
    return stage


def is_quick(stage: Callable[..., Any]) -> bool:
    """Whether a stage was marked by `quick`."""
    return stage in _QUICK


class Backend(Protocol):
    """Runs stages on workers. All methods are called in the engine's own event loop."""

    async def start(self) -> None:
        """Start the workers, or connect to external workers; return once one is warm."""

    async def stop(self) -> None:
        """Stop everything that was started."""

    async def install(self, weights: Weights) -> None:
        """Give weights to all workers, also to those that come later; once for each sha256."""

    async def remove(self, sha256: str) -> None:
        """Take weights away that were installed."""

    @property
    def warm_workers(self) -> int:
        """Number of workers that could run a task now."""

    @property
    def worker_names(self) -> tuple[str, ...]:
        """Their names, for ``submit``."""

    @property
    def worker_memory(self) -> int | None:
        """Bytes that each worker may use; ``None`` if they are unlimited or unknown."""

    @property
    def lost_workers(self) -> int:
        """Workers that ended unexpectedly since the start."""

    @property
    def retried_patches(self) -> int:
        """Patches whose task was run again because a worker was lost, since the start."""

    @property
    def uses(self) -> tuple[WorkerUse, ...]:
        """Memory and processor time of each worker, some seconds old."""

    def submit(
        self,
        stage: Callable[..., T],
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        worker: str | None = None,
    ) -> Handle[T]:
        """Queue ``stage(*args)`` and return a handle of its result.

        Args:
            stage: function of a module that workers can import.
            args: values, handles, or lists of handles; handles arrive as their results.
            priority: larger runs earlier.
            seconds: a worker that takes longer is ended.
            long: the stage takes seconds and not milliseconds.
            patches: number of patches that the task runs through the network.
            worker: name of the worker to run it while it exists; any if ``None``.
        """

    async def wait(self, handle: Handle[Any]) -> None:
        """Wait for a result without moving it.

        Raises:
            WorkerLostError: the task ended two workers.
            EngineLostError: the scheduler forgot the task.
            Exception: raised by the stage.
        """

    async def fetch(self, handle: Handle[T]) -> T:
        """Wait for a result and bring it here; raises as ``wait``."""

    def release(self, handles: Iterable[Handle[Any]]) -> None:
        """Drop results; tasks already submitted still get them."""

    def cancel(self, handles: Iterable[Handle[Any]]) -> None:
        """Drop results, and tasks that have not begun."""
