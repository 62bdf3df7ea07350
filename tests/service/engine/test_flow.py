# SPDX-License-Identifier: Apache-2.0
"""How a request is spread: few tasks at a time, small first, nobody starved, nothing left over."""

import asyncio
import errno
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_service.engine import flow as module
from pugeo_service.engine.errors import DiskFailed
from pugeo_service.engine.flow import Flow
from pugeo_service.engine.order import Head, Outcome, Sheet, Watcher
from pugeo_service.engine.sample import sample_order
from pugeo_service.spool import Spool

ORDER = replace(sample_order("standard", deadline_s=60.0), batch_patches=2)


@dataclass(eq=False)
class Handle:
    """A task as the pool got it."""

    stage: str
    args: tuple[Any, ...]
    priority: float
    long: bool
    live: bool = True


@dataclass
class Recorder:
    """A pool that does no work but notes what it is asked."""

    patches: int
    seconds: Callable[[Handle], float] = lambda _: 0.0
    fails: str = ""
    handles: list[Handle] = field(default_factory=list)
    running: int = 0
    most_running: int = 0
    warm_workers = 2
    lost_workers = 0
    retried_patches = 0

    async def start(self) -> None:
        """There is nothing to start."""

    async def stop(self) -> None:
        """There is nothing to stop."""

    def submit(
        self,
        stage: str,
        *args: Any,
        priority: float,
        seconds: float,
        long: bool,
        patches: int = 0,
    ) -> Handle:
        assert 0 < seconds <= ORDER.deadline_s
        assert patches == (args[0].args[2] - args[0].args[1] if stage == "predict" else 0)
        self.handles.append(Handle(stage, args, priority, long))
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
        match handle.stage:
            case "describe_prepared":
                return Head(self.patches, {"read": 0.0, "prepare": 0.0})
            case "describe_merged":
                return self.patches, 0.0, [(0.1, 2)]
            case "describe_written":
                return Sheet(3, b"0", {"points_in": 1}, {"finish": 0.0, "write": 0.0})
            case _:
                return str(handle.args[1]).encode()

    def release(self, handles: Iterable[Handle]) -> None:
        for handle in handles:
            handle.live = False

    cancel = release

    def of(self, stage: str) -> list[Handle]:
        """The tasks of one stage, in the order they were submitted."""
        return [handle for handle in self.handles if handle.stage == stage]


def run(pool: Recorder, tmp_path: Path, watcher: Watcher | None = None) -> tuple[Outcome, bytes]:
    """Run the order on the pool; return the outcome and its bytes."""

    async def whole() -> tuple[Outcome, bytes]:
        flow = Flow(pool, ORDER, asyncio.Semaphore(1), watcher or Watcher(), tmp_path)
        outcome = await flow.run(np.zeros(10, np.uint8))
        with outcome.spool as spool:
            return outcome, (await spool.read()).tobytes()

    return asyncio.run(whole())


def test_every_patch_once_and_in_order(tmp_path: Path) -> None:
    """Batches cover all patches, and reach merge in the order of the patches."""
    pool = Recorder(7, seconds=lambda handle: 0.05 if handle.args[0].args[1] == 0 else 0.0)
    _, data = run(pool, tmp_path)
    cuts = [handle.args[1:] for handle in pool.of("cut_patches")]
    assert cuts == [(0, 2), (2, 4), (4, 6), (6, 7)]
    for stage in ("propose", "merge"):
        charted = pool.of(stage)[0].args[1]
        assert [handle.args[0].args[1:] for handle in charted] == cuts
    assert data == b"012"


def test_few_batches_wait_at_one_time(tmp_path: Path) -> None:
    """Two for each worker, however many there are in all."""
    pool = Recorder(100, seconds=lambda _: 0.001)
    run(pool, tmp_path)
    assert len(pool.of("predict")) == 50
    assert pool.most_running == 4


def test_small_requests_use_all_workers(tmp_path: Path) -> None:
    """Two patches for two workers are two batches, though one could hold both."""
    pool = Recorder(2)
    run(pool, tmp_path)
    assert len(pool.of("predict")) == 2


def test_what_has_less_to_do_runs_earlier(tmp_path: Path) -> None:
    """A request's priority is what remains of it, so it grows with every batch."""
    pool = Recorder(20, seconds=lambda _: 0.001)
    run(pool, tmp_path)
    priorities = [handle.priority for handle in pool.of("predict")]
    assert priorities == sorted(priorities)
    assert priorities[0] == -20
    small = Recorder(2)
    run(small, tmp_path)
    assert min(handle.priority for handle in small.of("predict")) > priorities[0]


def test_long_stages_are_marked(tmp_path: Path) -> None:
    """Whole-cloud stages of large clouds are told apart, as Dask could not know."""
    for patches, long in ((module.LONG_PATCHES - 1, False), (module.LONG_PATCHES, True)):
        pool = Recorder(patches)
        run(pool, tmp_path)
        assert pool.of("merge")[0].long is long
        assert pool.of("finish")[0].long is long
        assert not pool.of("predict")[0].long


def test_nobody_starves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A request whose batches all wait gets its next one to the front."""
    monkeypatch.setattr(module, "_PATIENCE_S", 0.05)
    pool = Recorder(20, seconds=lambda handle: 0.2 if handle.priority < 0 else 0.0)
    run(pool, tmp_path)
    assert any(handle.priority > 0 for handle in pool.of("predict"))
    assert len(pool.of("predict")) == 10


def test_progress_is_told(tmp_path: Path) -> None:
    """First how many patches there are, then each batch."""
    told: list[tuple[str, int]] = []
    watcher = Watcher(
        lambda count: told.append(("all", count)), lambda count: told.append(("done", count))
    )
    run(Recorder(5), tmp_path, watcher)
    assert told[0] == ("all", 5)
    assert sum(count for what, count in told if what == "done") == 5


@pytest.mark.parametrize("stage", ["", "predict", "land"])
def test_nothing_is_left_over(tmp_path: Path, stage: str) -> None:
    """After a success and after an error, every handle is given back."""
    pool = Recorder(9, fails=stage)
    if stage:
        with pytest.raises(KeyError, match=stage):
            run(pool, tmp_path)
    else:
        run(pool, tmp_path)
    assert pool.running == 0
    assert not [handle for handle in pool.handles if handle.live]
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No room for the answer, however small its last piece, shows before the answer begins."""

    def store(_spool: Spool, _data: bytearray) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(Spool, "_store", store)
    pool = Recorder(3)
    with pytest.raises(DiskFailed) as caught:
        run(pool, tmp_path)
    assert caught.value.error.errno == errno.ENOSPC
    assert not any(handle.live for handle in pool.handles)
