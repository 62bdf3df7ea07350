# SPDX-License-Identifier: Apache-2.0
"""A pool that does no work, and requests that go their way through it."""

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pugeo_service.engine.messages import Head, InMemory, Order, Outcome, Sheet, Watcher
from pugeo_service.engine.orchestrator import Flow
from pugeo_service.engine.sample import sample_order
from pugeo_service.engine.scheduling import Lanes
from pugeo_service.storage.shared_file import SharedFile

__all__ = ["ORDER", "Handle", "Recorder", "run"]

ORDER = replace(sample_order("standard", deadline_s=60.0), batch_patches=2)


@dataclass(eq=False)
class Handle:
    """A task as the pool got it."""

    stage: str
    args: tuple[Any, ...]
    priority: float
    long: bool
    place: str | None
    live: bool = True


@dataclass
class Recorder:
    """A pool that does no work but notes what it is asked."""

    patches: int
    seconds: Callable[[Handle], float] = lambda _: 0.0
    fails: str = ""
    tiles: int = 1
    by_rows: bool = False
    handles: list[Handle] = field(default_factory=list)
    running: int = 0
    most_running: int = 0
    warm_workers = 2
    places = ("one", "two")
    lost_workers = 0
    retried_patches = 0

    async def start(self) -> None:
        """There is nothing to start, or to stop."""

    stop = start

    def submit(
        self,
        stage: str,
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
        place: str | None = None,
    ) -> Handle:
        assert 0 < seconds <= ORDER.deadline_s
        spans = {"predict": lambda: args[0].args[1:3], "predict_part": lambda: args[1:3]}
        start, stop = spans.get(stage, lambda: (0, 0))()
        assert patches == stop - start
        self.handles.append(Handle(stage, args, priority, long, place))
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
            "describe_prepared": Head(
                self.patches, self.tiles if whole else 1, {"prepare": 1.0}, self.by_rows
            ),
            "describe_finished": ({"land": 0.5, "merge": 0.25, "finish": 1.0}, [(0.1, 2)]),
            "describe_agreed": ({"points_in": 1}, 2.0),
            "describe_written": Sheet(
                3, b"0" if handle.args[-1] else b"", {"points_in": 1}, {"finish": 0.0, "write": 0.0}
            ),
        }
        return self.chunk(*handle.args[1:]) if handle.stage == "chunk" else answers[handle.stage]

    def chunk(self, start: int, _file: SharedFile, _offset: int) -> bytes | int:
        return str(start).encode()

    def release(self, handles: Iterable[Handle]) -> None:
        for handle in handles:
            handle.live = False

    cancel = release

    def of(self, stage: str) -> list[Handle]:
        """The tasks of one stage, in the order they were submitted."""
        return [handle for handle in self.handles if handle.stage == stage]


def run(
    pool: Recorder,
    tmp_path: Path,
    watcher: Watcher | None = None,
    *,
    order: Order = ORDER,
    size: int = 10,
    lanes: Lanes | None = None,
) -> tuple[Outcome, bytes]:
    """Run the order on the pool; return the outcome and its bytes."""

    async def whole() -> tuple[Outcome, bytes]:
        flow = Flow(pool, order, lanes or Lanes(lambda: 2), watcher or Watcher(), tmp_path)
        outcome = await flow.run(InMemory(np.zeros(size, np.uint8)))
        with outcome.spool as spool:
            return outcome, (await spool.read()).tobytes()

    return asyncio.run(whole())
