# SPDX-License-Identifier: Apache-2.0
"""The Dask backend with real worker processes, without the model."""

import asyncio
import contextlib
import gc
import importlib
import os
import signal
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed.batched import BatchedSend
from distributed.spans import Span
from tests.service.engine import light_stages as light
from tests.service.engine.light_tasks import known, submit, until, until_quick, warm

from pugeo_model.errors import MalformedFileError
from pugeo_model.weights import Weights
from pugeo_service.engine import dask_backend, dask_config
from pugeo_service.engine.dask_backend import DaskBackend
from pugeo_service.engine.errors import WorkerLostError
from pugeo_service.settings import Settings

pytestmark = pytest.mark.slow

Scenario = Callable[[DaskBackend], Coroutine[Any, Any, None]]
Play = Callable[..., None]
Run = Callable[[Coroutine[Any, Any, None]], None]


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Play:
    """Run a scenario against a backend of its own, with light workers."""
    config = {**dask_config.CONFIG, "distributed.worker.preload": [light.__name__]}
    monkeypatch.setattr(dask_config, "CONFIG", config)

    @asynccontextmanager
    async def opened(workers: int) -> AsyncIterator[DaskBackend]:
        backend = DaskBackend(Settings(workers=workers, spool_dir=tmp_path))
        try:
            await backend.start()
            yield backend
        finally:
            await backend.stop()

    async def run(scenario: Scenario, workers: int) -> None:
        async with opened(workers) as backend:
            await scenario(backend)

    return lambda scenario, workers=2: asyncio.run(run(scenario, workers))


@pytest.fixture(scope="module")
def play_shared(in_background: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Play]:
    """Run a scenario that loses no worker against one backend of one light worker."""
    config = {**dask_config.CONFIG, "distributed.worker.preload": [light.__name__]}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dask_config, "CONFIG", config)
        backend = DaskBackend(Settings(workers=1, spool_dir=tmp_path_factory.mktemp("spool")))
        try:
            in_background(backend.start())
            yield lambda scenario: in_background(scenario(backend))
        finally:
            in_background(backend.stop())


def test_results_feed_tasks(play: Play) -> None:
    """Handles and lists of handles are replaced by results, also after their release."""

    async def scenario(backend: DaskBackend) -> None:
        one = submit(backend, light.add, 1, 0)
        two = submit(backend, light.add, one, [one, one])
        three = submit(backend, light.add, two, np.float64(0.5))
        backend.release([one, two])
        assert await backend.fetch(three) == 3.5

    play(scenario)


def test_a_poison_task_and_its_bystanders(play: Play, tmp_path: Path) -> None:
    """A task that ends two workers fails; workers and results of other tasks are restored."""

    async def scenario(backend: DaskBackend) -> None:
        kept = submit(backend, light.add, 20, 22)
        await backend.wait(kept)
        poison = submit(backend, light.die, 0.3, priority=10)
        with pytest.raises(WorkerLostError):
            await backend.wait(poison)
        assert await backend.fetch(kept) == 42
        naps = [submit(backend, light.nap, 0.1, str(tmp_path / "log"), str(n)) for n in range(6)]
        assert [await backend.fetch(nap) for nap in naps] == list("012345")
        await warm(backend, 2)
        assert backend.lost_workers == 2

    play(scenario)


def test_retries_are_counted(play: Play, tmp_path: Path) -> None:
    """A task repeated after the loss of its worker counts with its patches."""

    async def scenario(backend: DaskBackend) -> None:
        log, gate = tmp_path / "log", tmp_path / "gate"
        held = submit(backend, light.hold, str(gate), str(log), "held", patches=5)
        await until(log.exists)
        assert backend.retried_patches == 0
        worker = next(iter(backend._cluster.workers.values()))
        await worker.kill()
        gate.touch()
        assert await backend.fetch(held) == "held"
        assert await backend.fetch(submit(backend, light.add, 1, 1, patches=7)) == 2
        await until(lambda: backend.retried_patches == 5)

    play(scenario, workers=1)


def test_weights_reach_workers_that_come_later(play: Play) -> None:
    """Installed weights are on each worker, also on one that replaces another; removed ones not."""

    async def scenario(backend: DaskBackend) -> None:
        async def there() -> bool:
            return bool(await backend.fetch(submit(backend, light.has_weights, "ab")))

        assert not await there()
        await backend.install(Weights({"sha256": "ab"}, b"weights"))
        assert await there()
        os.kill(next(iter(backend._pids().values())), signal.SIGKILL)
        await until(lambda: backend.lost_workers == 1)
        assert await there()
        await backend.remove("ab")
        assert not await there()

    play(scenario, workers=1)


def test_each_worker_tells_its_memory(play: Play) -> None:
    """A worker process reports resident bytes below its limit, and the cores that it uses."""

    async def scenario(backend: DaskBackend) -> None:
        await until(lambda: len(backend.uses) == 1)
        (use,) = backend.uses
        assert use.name in backend.worker_names
        assert 10_000_000 < use.memory < use.memory_limit
        assert 0.0 <= use.cores < 64.0

    play(scenario, workers=1)


def test_a_task_that_hangs_ends_its_worker(play: Play, tmp_path: Path) -> None:
    """After its time limit the worker process ends itself and is replaced."""

    async def scenario(backend: DaskBackend) -> None:
        log = tmp_path / "log"
        hung = submit(backend, light.nap, 600, str(log), "hung", seconds=0)
        await until(log.exists)
        backend.cancel([hung])  # it runs on, but is not repeated
        await until(lambda: backend.lost_workers == 1)
        assert await backend.fetch(submit(backend, light.add, 1, 1)) == 2

    play(scenario, workers=1)


def test_a_worker_without_a_core_does_not_count(
    play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that was started without the preload does not count as warm."""
    config = {**dask_config.CONFIG, "distributed.worker.preload": []}
    monkeypatch.setattr(dask_config, "CONFIG", config)

    async def scenario(backend: DaskBackend) -> None:
        assert (backend.warm_workers, backend.worker_names) == (0, ())

    play(scenario, workers=1)


def test_a_closed_nanny_is_replaced(play: Play) -> None:
    """A worker whose nanny has closed, as after a failed restart, is replaced."""

    async def scenario(backend: DaskBackend) -> None:
        first = await backend.fetch(submit(backend, light.pid))
        await next(iter(backend._cluster.workers.values())).close()
        await warm(backend, 1)
        assert await backend.fetch(submit(backend, light.pid)) != first

    play(scenario, workers=1)


def test_a_stopped_worker_is_replaced(play: Play, tmp_path: Path) -> None:
    """A worker that hangs is ended; its task is repeated elsewhere and another one comes."""
    gate, log = tmp_path / "gate", tmp_path / "log"

    async def scenario(backend: DaskBackend) -> None:
        await warm(backend, 2)
        held = submit(backend, light.hold, str(gate), str(log), "held")
        await until(log.exists)
        nannies = {nanny.worker_address: nanny.pid for nanny in backend._cluster.workers.values()}
        (address,) = [
            worker
            for worker, state in backend._cluster.scheduler.workers.items()
            if held.key in {task.key for task in state.processing}
        ]
        os.kill(nannies[address], signal.SIGSTOP)
        await until(lambda: backend.warm_workers == 1)
        gate.touch()
        assert await backend.fetch(held) == "held"
        await warm(backend, 2)
        assert nannies[address] not in {n.pid for n in backend._cluster.workers.values()}
        assert backend.lost_workers == 1

    play(scenario, workers=2)


@pytest.mark.filterwarnings("ignore:unclosed cluster:ResourceWarning")
def test_a_lost_scheduler_is_told_at_once(play: Play, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a connection to the scheduler no worker counts, before the next look."""
    monkeypatch.setattr(dask_backend, "_CLOSE_S", 1.0)

    async def scenario(backend: DaskBackend) -> None:
        await warm(backend, 1)
        assert backend._poll is not None
        backend._poll.cancel()
        await backend._cluster.scheduler.close()
        await until(lambda: backend.warm_workers == 0, 5.0)

    play(scenario, workers=1)
    gc.collect()  # the cluster, which may not close without its scheduler


@pytest.mark.filterwarnings("ignore:unclosed cluster:ResourceWarning")
def test_a_worker_that_is_stopped_while_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start is given up, and the stop ends the process, which cannot end itself."""
    psutil: Any = importlib.import_module("psutil")
    monkeypatch.setattr(dask_backend, "_CLUSTER_START_S", 0.5)

    def runs(process: Any) -> bool:
        try:
            return bool(process.status() != psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return False

    def is_worker(process: Any) -> bool:
        try:
            return "spawn_main" in " ".join(process.cmdline())
        except psutil.Error:  # it has ended, or is a zombie
            return False

    async def run() -> None:
        backend = DaskBackend(Settings(workers=1, spool_dir=tmp_path))
        starting = asyncio.create_task(backend.start())
        children: list[Any] = []

        def born() -> bool:
            children[:] = filter(is_worker, psutil.Process().children(recursive=True))
            return bool(children)

        await until(born)
        children[0].suspend()
        starting.cancel()
        await asyncio.gather(starting, return_exceptions=True)
        await backend.stop()
        await until(lambda: not any(map(runs, children)))

    asyncio.run(run())
    gc.collect()  # the cluster, which did not come up


def test_a_stop_ends_no_workers_of_another_backend(play: Play, play_shared: Play) -> None:
    """Two backends of one process have their own workers; a stop ends those of its own backend."""
    psutil: Any = importlib.import_module("psutil")
    pids: list[int] = []

    async def pid(backend: DaskBackend) -> None:
        pids.append(await backend.fetch(submit(backend, light.pid)))

    play_shared(pid)
    play(pid, workers=1)
    play_shared(pid)
    shared, own, again = pids
    assert (again, psutil.pid_exists(own)) == (shared, False)


def test_errors_of_a_stage_arrive(play_shared: Play) -> None:
    """A CloudError keeps its code and fields, also through a dependent task."""

    async def scenario(backend: DaskBackend) -> None:
        bad = submit(backend, light.refuse)
        for handle in (bad, submit(backend, light.add, 1, bad)):
            with pytest.raises(MalformedFileError, match="cut short") as caught:
                await backend.wait(handle)
            assert (caught.value.code, caught.value.fields) == ("truncated", {"expected": 7})

    play_shared(scenario)


def test_nothing_is_kept_of_what_is_done(play_shared: Play) -> None:
    """Neither records of tasks nor bodies in logs of messages are kept."""

    async def scenario(backend: DaskBackend) -> None:
        for number in range(30):
            handle = submit(backend, light.add, number, np.zeros(1000))
            await backend.fetch(handle)
            backend.release([handle])
        gc.collect()
        kept = gc.get_objects()
        logs = [len(each.recent_message_log) for each in kept if type(each) is BatchedSend]
        assert 0 < max(logs) <= 10
        assert not [each for each in kept if type(each) is Span]

    play_shared(scenario)


def test_priority_decides(play_shared: Play, tmp_path: Path) -> None:
    """A task submitted later with a higher priority runs earlier."""
    log = tmp_path / "log"

    async def scenario(backend: DaskBackend) -> None:
        gate = str(tmp_path / "gate")
        first = submit(backend, light.hold, gate, str(log), "first")
        await until(log.exists)
        await until_quick(backend)
        large = [submit(backend, light.log, str(log), "large", priority=-100) for _ in range(8)]
        small = submit(backend, light.log, str(log), "small", priority=-1)
        await until(lambda: known(backend, [small, *large]) == 9)
        # Messages to the worker are ordered, so it knows all tasks when it opens the gate.
        await backend.wait(submit(backend, light.open_gate, gate))
        for handle in [first, small, *large]:
            await backend.wait(handle)
        assert log.read_text().split() == ["first", "small", *["large"] * 8]

    play_shared(scenario)


def test_quick_stages_do_not_wait(play_shared: Play, tmp_path: Path) -> None:
    """A quick stage runs beside one that computes; stages that compute run one at a time."""
    log = tmp_path / "log"

    async def scenario(backend: DaskBackend) -> None:
        gate = tmp_path / "gate"
        held = [
            submit(backend, light.hold, str(gate), str(log), name) for name in ("first", "second")
        ]
        await until(lambda: log.exists() and log.read_text() == "first\n")
        await until_quick(backend)
        assert log.read_text().split() == ["first"]
        gate.touch()
        assert [await backend.fetch(each) for each in held] == ["first", "second"]

    play_shared(scenario)


def test_cancelled_tasks_do_not_begin(play_shared: Play, tmp_path: Path) -> None:
    """Cancelled tasks that have not begun leave the queue."""
    log = tmp_path / "log"

    async def scenario(backend: DaskBackend) -> None:
        gate = str(tmp_path / "gate")
        first = submit(backend, light.hold, gate, str(log), "first")
        await until(log.exists)
        await until_quick(backend)
        handles = [submit(backend, light.log, str(log), str(n)) for n in range(10)]
        await until(lambda: known(backend, handles) == 10)
        backend.cancel(handles)
        await until(lambda: known(backend, handles) == 0)
        # Messages to the worker are ordered, so it has dropped the tasks when it opens the gate.
        await backend.wait(submit(backend, light.open_gate, gate))
        await backend.wait(first)
        assert await backend.fetch(submit(backend, light.add, 1, 1)) == 2
        assert log.read_text().split() == ["first"]

    play_shared(scenario)


def test_nothing_else_listens(play_shared: Play) -> None:
    """Every port of the cluster is on the loopback interface; its web server has no page."""
    psutil: Any = importlib.import_module("psutil")

    async def scenario(backend: DaskBackend) -> None:
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        ports = []
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess):  # one of an earlier test that ends
                found = process.net_connections("inet")
                ports += [each.laddr for each in found if each.status == psutil.CONN_LISTEN]
        assert ports
        assert {address.ip for address in ports} == {"127.0.0.1"}
        assert backend._cluster.scheduler.http_application.find_handler is not None
        web = backend._cluster.scheduler.http_server.port
        reader, writer = await asyncio.open_connection("127.0.0.1", web)
        writer.write(b"GET /info/main/workers.html HTTP/1.0\r\n\r\n")
        assert b"404" in await reader.readline()
        writer.close()
        await writer.wait_closed()

    play_shared(scenario)
