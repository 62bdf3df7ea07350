# SPDX-License-Identifier: Apache-2.0
"""A backend that records tasks without running them, and requests that use it."""

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from tests.service.engine.standard import STANDARD

from pugeo_service.engine.backend import Backend
from pugeo_service.engine.messages import (
    AgreementInfo,
    DenseInfo,
    InMemory,
    OutputInfo,
    PreparedInfo,
    ProgressCallbacks,
    RunRequest,
    RunResult,
)
from pugeo_service.engine.orchestrator import Orchestrator
from pugeo_service.engine.scheduling import SchedulingPolicy
from pugeo_service.engine.self_test import self_test_request
from pugeo_service.observability.telemetry import WorkerUse
from pugeo_service.storage.shared_file import SharedFile

__all__ = ["REQUEST", "Handle", "Recorder", "run"]

REQUEST = self_test_request(STANDARD, deadline_s=60.0)


@dataclass(eq=False)
class Handle:
    """A submitted task."""

    stage: str
    args: tuple[Any, ...]
    priority: float
    long: bool
    worker: str | None
    live: bool = True


@dataclass
class Recorder:
    """Backend that records tasks and returns fixed descriptions."""

    patches: int
    seconds: Callable[[Handle], float] = lambda _: 0.0
    fails: str = ""
    tiles: int = 1
    by_rows: bool = False
    handles: list[Handle] = field(default_factory=list)
    running: int = 0
    most_running: int = 0
    warm_workers = 2
    worker_names = ("one", "two")
    lost_workers = 0
    worker_memory: int | None = None
    retried_patches = 0
    uses: tuple[WorkerUse, ...] = ()

    async def start(self) -> None:
        """Do nothing."""

    stop = start

    def submit(
        self,
        stage: Callable[..., Any],
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        worker: str | None = None,
    ) -> Handle:
        assert 0 < seconds <= REQUEST.deadline_s
        name = stage.__name__
        spans = {"predict": lambda: args[0].args[1:3], "predict_in_place": lambda: args[1:3]}
        start, stop = spans.get(name, lambda: (0, 0))()
        assert patches == stop - start
        self.handles.append(Handle(name, args, priority, long, worker))
        return self.handles[-1]

    async def wait(self, handle: Handle) -> None:
        self.running += 1
        self.most_running = max(self.most_running, self.running)
        try:
            await asyncio.sleep(self.seconds(handle))
        finally:
            self.running -= 1
        if handle.stage == self.fails:
            raise KeyError(handle.stage)

    async def fetch(self, handle: Handle) -> Any:
        await asyncio.sleep(0)
        if handle.args and getattr(handle.args[0], "stage", None) == self.fails:
            raise KeyError(self.fails)
        whole = handle.args[0].stage == "prepare"
        answers: dict[str, Any] = {
            "describe_prepared": PreparedInfo(
                self.patches, self.tiles if whole else 1, {"prepare": 1.0}, self.by_rows
            ),
            "describe_dense": DenseInfo({"project": 0.5, "merge": 0.25, "finish": 1.0}, [(0.1, 2)]),
            "describe_agreements": AgreementInfo({"points_in": 1}, {"finish": 2.0}),
            "describe_output": OutputInfo(
                3, b"0" if handle.args[-1] else b"", {"points_in": 1}, {"finish": 0.0, "write": 0.0}
            ),
        }
        if handle.stage == "read_chunk":
            return self.chunk(*handle.args[1:])
        return answers[handle.stage]

    def chunk(self, start: int, _file: SharedFile, _offset: int) -> bytes | int:
        return str(start).encode()

    def release(self, handles: Iterable[Handle]) -> None:
        for handle in handles:
            handle.live = False

    cancel = release

    def of(self, stage: str) -> list[Handle]:
        """The tasks of one stage in the order of submission."""
        return [handle for handle in self.handles if handle.stage == stage]


def run(
    pool: Recorder,
    tmp_path: Path,
    progress: ProgressCallbacks | None = None,
    *,
    request: RunRequest = REQUEST,
    size: int = 10,
    policy: SchedulingPolicy | None = None,
) -> tuple[RunResult, bytes]:
    """Run a request on the recorder; return the result and its bytes."""

    async def whole() -> tuple[RunResult, bytes]:
        orchestrator = Orchestrator(
            cast("Backend", pool),
            request,
            policy or SchedulingPolicy(lambda: 2),
            progress or ProgressCallbacks(),
            tmp_path,
        )
        outcome = await orchestrator.run(InMemory(np.zeros(size, np.uint8)))
        with outcome.spool as spool:
            return outcome, (await spool.read()).tobytes()

    return asyncio.run(whole())
