# SPDX-License-Identifier: Apache-2.0
"""The engine as a whole, with the real model."""

import asyncio
import dataclasses
import errno
import io
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.service.engine.standard import STANDARD

from pugeo_model import Cloud, formats
from pugeo_model.errors import MalformedFileError
from pugeo_service.engine import (
    DiskError,
    Engine,
    EngineLostError,
    RunRequest,
    RunResult,
    WorkerLostError,
    dask_config,
)
from pugeo_service.engine.self_test import self_test_body, self_test_request
from pugeo_service.settings import Settings
from pugeo_service.storage.shared_file import NOWHERE, SharedFile
from pugeo_service.storage.spool import Spool

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("_kernels")]

REQUEST = self_test_request(STANDARD, deadline_s=60.0)

Scenario = Callable[[Engine], Coroutine[Any, Any, None]]
Play = Callable[[Scenario], None]
Run = Callable[[Coroutine[Any, Any, None]], None]


class Progress:
    """Recorded progress."""

    def __init__(self) -> None:
        self.patches: list[int] = []
        self.done: list[int] = []


async def run(
    engine: Engine,
    data: bytes,
    tmp_path: Path,
    request: RunRequest = REQUEST,
    on_patches: Callable[[int], object] = lambda _: None,
) -> tuple[RunResult, Progress]:
    """Run a request on some bytes."""
    progress = Progress()

    def told(count: int) -> None:
        progress.patches.append(count)
        on_patches(count)

    with Spool(tmp_path) as body:
        await body.write(data)
        outcome = await engine.run(body, request, on_patches=told, on_done=progress.done.append)
    # The last call of the engine's thread may still be queued in this loop.
    await asyncio.sleep(0)
    return outcome, progress


@pytest.fixture(scope="module")
def play(in_background: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Play]:
    """Run a scenario against the engine that all tests share: two workers, which poison ends."""
    trap = Path(__file__).with_name("preload_poison.py")
    config = {**dask_config.CONFIG, "distributed.worker.preload": [str(trap)]}
    settings = Settings(workers=2, spool_dir=tmp_path_factory.mktemp("spool"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dask_config, "CONFIG", config)
        engine = Engine(settings, STANDARD)
        assert engine.status.workers == 0
        try:
            in_background(engine.start())
            assert engine.status.workers == 2
            yield lambda scenario: in_background(scenario(engine))
        finally:
            in_background(engine.stop())


@pytest.fixture
def play_inline(tmp_path: Path) -> Play:
    """Run a scenario against an engine of threads."""

    async def whole(scenario: Scenario) -> None:
        engine = Engine(Settings(engine="inline", workers=2, spool_dir=tmp_path), STANDARD)
        assert engine.status.workers == 0
        await engine.start()
        try:
            assert engine.status.workers == 2
            await scenario(engine)
        finally:
            await engine.stop()

    return lambda scenario: asyncio.run(whole(scenario))


def points(outcome: RunResult) -> NDArray[np.float32]:
    """The points of an answer, which is closed."""

    async def read() -> bytes:
        with outcome.spool as spool:
            return (await spool.read()).tobytes()

    return formats.read(io.BytesIO(asyncio.run(read())), format="ply").points


@pytest.mark.parametrize("backend", ["play_inline", "play"])
def test_both_backends_do_the_same(
    request: pytest.FixtureRequest, tmp_path: Path, backend: str
) -> None:
    """Both backends have the same results, reports, stages, progress and errors."""
    found: list[RunResult] = []

    async def scenario(engine: Engine) -> None:
        outcome, progress = await run(engine, self_test_body().tobytes(), tmp_path)
        found.append(outcome)
        assert outcome.report["points_out"] == 6000
        assert progress.patches == [2]
        assert progress.done == [1, 1]
        assert [patches for _, patches in outcome.batches] == [1, 1]
        assert list(outcome.seconds) == [
            "queue", "read", "prepare", "predict", "merge", "project", "finish", "write", "collect",
        ]  # fmt: skip
        with pytest.raises(MalformedFileError):
            await run(engine, self_test_body().tobytes()[:-1], tmp_path)

    request.getfixturevalue(backend)(scenario)
    sphere = points(found[0])
    assert sphere.shape == (6000, 3)
    assert np.abs(np.linalg.norm(sphere, axis=1) - 1).max() < 0.1


def test_the_answer_comes_by_file_or_by_connection(
    play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bytes are the same by file and by connection, as for an external worker."""
    took: list[bool] = []
    take = Spool.take

    async def watched(spool: Spool, data: bytes | int) -> int:
        took.append(isinstance(data, int))
        return await take(spool, data)

    async def elsewhere(_spool: Spool) -> SharedFile:
        return NOWHERE

    monkeypatch.setattr(Spool, "take", watched)
    answers = []

    async def scenario(engine: Engine) -> None:
        took.clear()
        for here in (True, False):
            if not here:
                monkeypatch.setattr(Spool, "share", elsewhere)
            outcome, _ = await run(engine, self_test_body().tobytes(), tmp_path)
            with outcome.spool as spool:
                answers.append((await spool.read()).tobytes())

    play(scenario)
    assert took == [Path("/proc/self/fd").exists(), False]
    assert len(answers[0]) > 6000 * 24
    assert answers[0] == answers[1]


@pytest.mark.long
def test_a_request_that_ends_workers(play: Play, tmp_path: Path) -> None:
    """It fails alone after a second attempt; other requests are served."""

    async def scenario(engine: Engine) -> None:
        data = self_test_body().tobytes()
        lost = engine.status.lost
        poison = asyncio.create_task(run(engine, b"POISON", tmp_path))
        beside = [asyncio.create_task(run(engine, data, tmp_path)) for _ in range(3)]
        with pytest.raises(WorkerLostError):
            await poison
        for task in beside:
            (await task)[0].spool.close()
        (await run(engine, data, tmp_path))[0].spool.close()
        # Two attempts end two workers each; one that is replaced between two polls is not counted.
        assert 2 <= engine.status.lost - lost <= 4

    play(scenario)


def test_cancelling_a_request(play: Play, tmp_path: Path) -> None:
    """A cancelled request leaves neither a task nor a place in the queue."""
    points = np.random.default_rng(0).normal(size=(80_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(points), buffer, format="ply")
    large = dataclasses.replace(REQUEST, max_points=10**6, max_output_points=10**7)

    async def scenario(engine: Engine) -> None:
        begun = asyncio.Event()
        task = asyncio.create_task(
            run(engine, buffer.getvalue(), tmp_path, large, lambda _: begun.set())
        )
        started = asyncio.create_task(begun.wait())
        await asyncio.wait({task, started}, return_when=asyncio.FIRST_COMPLETED)
        assert begun.is_set(), task
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        (await run(engine, self_test_body().tobytes(), tmp_path))[0].spool.close()
        assert engine._policy.requests == set()
        backend: Any = engine._backend
        # Running tasks end, and no further one begins.
        async with asyncio.timeout(100):
            while backend._cluster.scheduler.tasks:  # noqa: ASYNC110 - it belongs to another loop
                await asyncio.sleep(0.05)

    play(scenario)


def test_an_engine_that_does_not_run(tmp_path: Path) -> None:
    """A request before the start is refused, and stopping without a start is allowed."""

    async def scenario() -> None:
        engine = Engine(Settings(spool_dir=tmp_path), STANDARD)
        with pytest.raises(EngineLostError):
            await run(engine, b"", tmp_path)
        await engine.stop()

    asyncio.run(scenario())


def test_a_body_that_cannot_be_read(play_inline: Play, tmp_path: Path) -> None:
    """An error of the disk is a DiskError, and the next request is served."""

    class Unreadable:
        size = 1

        async def read(self) -> NDArray[np.uint8]:
            raise OSError(errno.EIO, "gone")

    async def scenario(engine: Engine) -> None:
        with pytest.raises(DiskError) as caught:
            await engine.run(Unreadable(), REQUEST, on_patches=print, on_done=print)
        assert caught.value.error.errno == errno.EIO
        outcome, _ = await run(engine, self_test_body().tobytes(), tmp_path)
        outcome.spool.close()

    play_inline(scenario)
