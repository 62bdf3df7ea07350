# SPDX-License-Identifier: Apache-2.0
"""Orchestration of a request: order of tasks, progress, and release of all results."""

import asyncio
import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from tests.service.engine.recorder import REQUEST, Handle, Recorder, run

from pugeo_service.engine import dispatch as module
from pugeo_service.engine import stages
from pugeo_service.engine.backend import Backend
from pugeo_service.engine.errors import EngineLostError
from pugeo_service.engine.messages import InMemory, OutputInfo, PreparedInfo, ProgressCallbacks
from pugeo_service.engine.orchestrator import Orchestrator
from pugeo_service.engine.scheduling import LARGE_PATCHES, SchedulingPolicy


@pytest.fixture(autouse=True)
def two_patches_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks of two patches, so that parts differ from patches."""
    monkeypatch.setattr(module, "_CARRIED_PATCHES", 2)


def test_every_patch_once_and_in_order(tmp_path: Path) -> None:
    """Batches cover all patches and are passed on in order."""
    pool = Recorder(7, seconds=lambda handle: 0.05 if handle.args[0].args[1] == 0 else 0.0)
    _, data = run(pool, tmp_path)
    cuts = [handle.args[1:] for handle in pool.of("take_patches")]
    assert cuts == [(0, 2), (2, 4), (4, 6), (6, 7)]
    charted = pool.of("densify")[0].args[1]
    assert [handle.args[0].args[1:] for handle in charted] == cuts
    assert data == b"012"


def test_a_cloud_in_tiles(tmp_path: Path) -> None:
    """Each tile runs once, as many at a time as there are workers; then they are assembled."""
    pool = Recorder(9, seconds=lambda _: 0.001, tiles=5)
    outcome, data = run(pool, tmp_path)
    assert data == b"012"
    (joined,) = pool.of("assemble")
    assert [piece.stage for piece in joined.args[1]] == ["densify"] * 5
    tiles = [piece.args[0].args[0] for piece in joined.args[1]]
    assert [tile.args[1] for tile in tiles] == list(range(5))
    order = [handle.stage for handle in pool.handles if handle.stage.endswith("_tile")]
    assert order[:2] == ["take_tile", "prepare_tile"]
    assert (outcome.seconds["prepare"], len(outcome.batches)) == (6.0, 5)
    assert not any(handle.live for handle in pool.handles)


def test_tiles_stay_on_their_workers(tmp_path: Path) -> None:
    """Each worker has a whole tile; one without a tile helps with the last one."""
    pool = Recorder(9, seconds=lambda _: 0.001, tiles=3, by_rows=True)
    run(pool, tmp_path)
    jobs = pool.of("prepare_tile")
    assert [job.worker for job in jobs[:2]] == ["one", "two"]
    for job in jobs[:2]:
        parts = [part for part in pool.of("predict_in_place") if part.args[0] is job]
        assert sorted(part.args[1:3] for part in parts) == [(0, 3), (3, 6), (6, 9)]
        assert {part.worker for part in parts} == {job.worker}
    helped = [part for part in pool.of("predict") if part.args[0].args[0] is jobs[2]]
    assert {part.worker for part in helped} == {"one", "two"}


def test_parts_go_to_the_least_loaded_worker(tmp_path: Path) -> None:
    """Parts are placed on the worker with the fewest queued tasks."""
    pool, policy = Recorder(7, seconds=lambda _: 0.001), SchedulingPolicy(lambda: 2)
    policy.load["one"] = 2
    run(pool, tmp_path, policy=policy)
    assert [part.worker for part in pool.of("predict")] == ["two", "two", "one", "two"]
    assert policy.load["two"] == policy.load["one"] - 2 == 0


def test_nothing_is_spread_when_each_worker_has_a_request(tmp_path: Path) -> None:
    """If each worker has a request, a small cloud is one task; a job stays in parts."""
    policy = SchedulingPolicy(lambda: 2)
    asked: list[int] = []
    for others in (0, 1):
        for request in (REQUEST, replace(REQUEST, background=True)):
            pool = Recorder(2)
            run(pool, tmp_path, request=request, policy=policy)
            asked.append(pool.of("prepare")[0].args[1].one_task_patches)
            assert len(pool.of("predict")) == 1 - others
        policy.register(others, 1, background=False)
    assert asked == [1, 1, LARGE_PATCHES - 1, 1]


@pytest.mark.parametrize("stage", ["predict_in_place", "prepare_tile", "agree", "write_tile"])
def test_a_tile_that_fails(tmp_path: Path, stage: str) -> None:
    """The error of a tile is that of the cloud, and the other tiles are released."""
    pool = Recorder(9, fails=stage, tiles=5, by_rows=True)
    with pytest.raises(KeyError, match=stage):
        run(pool, tmp_path)
    assert pool.running == 0
    assert not any(handle.live for handle in pool.handles)


def test_a_cloud_of_one_task(tmp_path: Path) -> None:
    """A small cloud needs one task and its description; its patches count as done."""

    class Quick(Recorder):
        async def fetch(self, handle: Handle) -> Any:
            if handle.stage == "describe_prepared":
                output = OutputInfo(
                    2,
                    b"0",
                    {"points_in": 1},
                    {"prepare": 1.0, "predict": 2.0, "finish": 0.5},
                    ((2.0, 1),),
                )
                return PreparedInfo(1, 1, {}, output=output)
            return await super().fetch(handle)

    done: list[int] = []
    pool = Quick(1)
    outcome, data = run(pool, tmp_path, ProgressCallbacks(on_done=done.append))
    assert data == b"01"
    assert [handle.stage for handle in pool.handles] == [
        "prepare",
        "describe_prepared",
        "read_chunk",
    ]
    assert (outcome.batches, done) == ([(2.0, 1)], [1])
    assert outcome.seconds["finish"] == 0.5
    assert not any(handle.live for handle in pool.handles)


def test_few_batches_wait_at_one_time(tmp_path: Path) -> None:
    """At most two batches per worker are queued, and one that has a turn."""
    pool = Recorder(100, seconds=lambda _: 0.001)
    run(pool, tmp_path)
    assert len(pool.of("predict")) == 50
    assert pool.most_running == 5


def test_small_requests_go_before_large_ones(tmp_path: Path) -> None:
    """All tasks of small requests precede batches of large ones without a turn."""
    large, small = Recorder(20), Recorder(LARGE_PATCHES - 1)
    for pool in (large, small):
        run(pool, tmp_path)
    tasks = ("predict", "densify")
    ranks = {handle.priority for stage in tasks for handle in small.of(stage)}
    assert len(ranks) == 1
    assert min(ranks) > min(handle.priority for handle in large.of("predict"))
    # Dask estimates durations by this flag.
    assert not any(handle.long for handle in small.handles)


def test_large_requests_have_turns(tmp_path: Path) -> None:
    """One task of large requests at a time has the highest priority."""
    pool = Recorder(80, seconds=lambda _: 0.01)
    policy = SchedulingPolicy(lambda: 2)
    run(pool, tmp_path, policy=policy)
    assert pool.of("densify")[0].priority == SchedulingPolicy.FIRST
    assert pool.of("densify")[0].long
    assert {handle.priority == SchedulingPolicy.FIRST for handle in pool.of("predict")} == {
        True,
        False,
    }
    assert policy.turns.holders == policy.large_requests.holders == 0


def test_as_many_large_requests_begin_as_there_are_workers(tmp_path: Path) -> None:
    """The body of the next large request is read when one has ended; small ones do not wait."""
    policy = SchedulingPolicy(lambda: 1)
    begun: list[str] = []

    class Gated(Recorder):
        gate: asyncio.Event | None = None

        async def wait(self, handle: Handle) -> None:
            if self.gate is not None:
                await self.gate.wait()
            await super().wait(handle)

    class Body(InMemory):
        def __init__(self, name: str, size: int, at_read: asyncio.Event) -> None:
            super().__init__(np.zeros(size, np.uint8))
            self.name = name
            self._at_read = at_read

        async def read(self) -> Any:
            begun.append(self.name)
            self._at_read.set()
            return await super().read()

    async def all_of_them() -> None:
        large = LARGE_PATCHES * 2048 * 12
        names = ("large", "text", "next", "small")
        read = {name: asyncio.Event() for name in names}
        ended = {name: asyncio.Event() for name in names}
        # The first one runs until the small one has ended, the second until the third has begun.
        gates = {"large": ended["small"], "text": read["next"]}

        async def one(name: str, size: int, patches: int) -> None:
            pool = Gated(patches)
            pool.gate = gates.get(name)
            run = Orchestrator(
                cast("Backend", pool), REQUEST, policy, ProgressCallbacks(), tmp_path
            ).run(Body(name, size, read[name]))
            (await run).spool.close()
            begun.append(f"{name} ended")
            ended[name].set()

        bodies = ("large", large, 9), ("text", large, 3), ("next", large, 9), ("small", 10, 1)
        await asyncio.gather(*(one(*body) for body in bodies))

    asyncio.run(all_of_them())
    assert begun[:3] == ["large", "small", "small ended"]
    # A cloud that turned out to be small leaves its place at once.
    assert begun.index("large ended") < begun.index("text") < begun.index("next")
    assert begun.index("next") < begun.index("text ended")


def test_large_requests_are_not_starved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All batches of a large request are done in turns behind endless small requests."""
    monkeypatch.setattr(module, "_PATIENCE_S", 0.05)
    pool = Recorder(20, seconds=lambda handle: 30.0 if handle.priority < 0 else 0.0)
    _, data = run(pool, tmp_path)
    assert data == b"012"
    cuts = [handle.args[1:] for handle in pool.of("take_patches") if handle.priority > 0]
    assert sorted(cuts) == [(start, start + 2) for start in range(0, 20, 2)]


def test_background_orders_are_not_starved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All tasks of a job are done, one per period, behind endless requests."""
    monkeypatch.setattr(module, "_BACKGROUND_PATIENCE_S", 0.05)
    request = replace(REQUEST, background=True)

    class Busy(Recorder):
        async def fetch(self, handle: Handle) -> Any:
            source = handle.args[0] if handle.stage.startswith("describe") else handle
            if source.priority < 0:
                await asyncio.sleep(30)
            return await super().fetch(handle)

    pool = Busy(3, seconds=lambda handle: 30.0 if handle.priority < 0 else 0.0)
    _, data = run(pool, tmp_path, request=request)
    assert data == b"012"
    cuts = [handle.args[1:] for handle in pool.of("take_patches") if handle.priority > 0]
    assert sorted(cuts) == [(0, 2), (2, 3)]


def test_progress_is_told(tmp_path: Path) -> None:
    """First the number of patches is reported, then each batch."""
    told: list[int] = []
    run(Recorder(5), tmp_path, ProgressCallbacks(lambda count: told.append(-count), told.append))
    assert told[0] == -5
    assert sum(told[1:]) == 5


@pytest.mark.parametrize(("queued", "turn"), [(1, False), (4, True)])
def test_a_part_that_cannot_be_queued(tmp_path: Path, queued: int, turn: bool) -> None:
    """An error while queueing, of one of the first parts or of one with a turn."""

    class Broken(Recorder):
        def submit(self, stage: Any, *args: Any, priority: float, **more: Any) -> Handle:
            if stage is stages.take_patches and len(self.of("take_patches")) == queued:
                raise EngineLostError(f"turn: {priority == SchedulingPolicy.FIRST}")
            return super().submit(stage, *args, priority=priority, **more)

    pool, policy = Broken(40, seconds=lambda _: 0.001), SchedulingPolicy(lambda: 2)
    with pytest.raises(EngineLostError, match=str(turn)):
        run(pool, tmp_path, policy=policy)
    assert not any([*policy.load.values(), *(handle.live for handle in pool.handles)])


@pytest.mark.parametrize("stage", ["", "predict", "densify"])
def test_nothing_is_left_over(tmp_path: Path, stage: str) -> None:
    """After a success and after an error all handles are released."""
    pool = Recorder(9, fails=stage)
    with pytest.raises(KeyError, match=stage) if stage else contextlib.nullcontext():
        run(pool, tmp_path)
    assert pool.running == 0
    assert not [handle for handle in pool.handles if handle.live]
    assert list(tmp_path.iterdir()) == []
