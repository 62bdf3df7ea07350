# SPDX-License-Identifier: Apache-2.0
"""A worker of another machine that hangs loses its tasks, and starts again."""

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from tests.free_port import free_port
from tests.service.engine import light_stages as light
from tests.service.engine.light_tasks import submit, until, warm

from pugeo_service.engine import dask_config, scheduler_host, worker_host, worker_watch
from pugeo_service.engine.dask_backend import DaskBackend
from pugeo_service.settings import Settings

Pids = Callable[[], dict[str, int]]
Scenario = Callable[[DaskBackend, Pids, Callable[[], None]], Awaitable[None]]


@pytest.fixture
def play(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Scenario], None]:
    """Run a scenario with a scheduler, a host of two light workers, and a front, over TLS.

    The scenario gets the backend of the front, a function that returns the process ids of the
    present workers by their addresses (a busy machine may replace one), and one that lets the
    host leave.
    """
    config = {**dask_config.CONFIG, "distributed.worker.preload": [light.__name__]}
    monkeypatch.setattr(dask_config, "CONFIG", config)
    monkeypatch.setattr(worker_host, "compile_kernels", lambda *_: None)
    monkeypatch.setattr(scheduler_host, "_allow_descriptors", lambda: None)
    subprocess.run([sys.executable, root / "deploy/make_certs.py", tmp_path], check=True)
    files: dict[str, Any] = {
        f"tls_{name}": tmp_path / f"{name}.pem" for name in ("ca", "cert", "key")
    }

    async def run(scenario: Scenario) -> None:
        settings = Settings(
            scheduler=f"tls://127.0.0.1:{free_port()}", workers=2, spool_dir=tmp_path, **files
        )
        stop, over = asyncio.Event(), asyncio.Event()
        host, backend = worker_host.WorkerHost(settings), DaskBackend(settings)
        scheduling = asyncio.create_task(scheduler_host.run_scheduler(settings, over))
        working = asyncio.create_task(host.run(stop))
        try:
            await host._reached.wait()
            await backend.start()
            await warm(backend, 2)
            await scenario(
                backend, lambda: {each.worker_address: each.pid for each in host._nannies}, stop.set
            )
        finally:
            await backend.stop()
            stop.set()
            assert await working == 0
            over.set()
            assert await scheduling == 0

    return lambda scenario: asyncio.run(run(scenario))


async def addresses(backend: DaskBackend) -> set[str]:
    """The addresses of the workers that the scheduler has."""
    return set((await backend._client.scheduler.identity(n_workers=-1))["workers"])


async def until_gone(backend: DaskBackend, address: str, left: int) -> None:
    """Wait until the scheduler has so many workers, and this one is not among them."""
    for _ in range(1000):
        found = await addresses(backend)
        if len(found) == left and address not in found:
            return
        await asyncio.sleep(0.1)
    pytest.fail(f"still {found}")


@pytest.mark.slow
def test_a_stopped_worker_is_replaced(play: Callable[[Scenario], None], tmp_path: Path) -> None:
    """Its task runs elsewhere, its process is ended, and another one comes."""
    gate, log = tmp_path / "gate", tmp_path / "log"

    async def scenario(backend: DaskBackend, pids: Pids, _: object) -> None:
        held = submit(backend, light.hold, str(gate), str(log), "held")
        await until(log.exists)
        processing = await backend._client.processing()
        (address,) = [worker for worker, keys in processing.items() if held.key in keys]
        pid = pids()[address]
        os.kill(pid, signal.SIGSTOP)
        # The other worker has begun it, while the gate is still closed.
        await until(lambda: log.read_text().split() == ["held", "held"])
        gate.touch()
        assert await backend.fetch(held) == "held"
        await until_gone(backend, address, 2)
        assert not psutil.pid_exists(pid)

    play(scenario)


@pytest.mark.slow
def test_a_worker_that_goes_on_comes_back(
    play: Callable[[Scenario], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was removed, and whose process could not be ended, ends itself and is replaced."""

    async def never(*_: Any) -> None: ...

    monkeypatch.setattr(worker_watch.WorkerWatch, "_restart", never)

    async def scenario(backend: DaskBackend, pids: Pids, _: object) -> None:
        address, pid = next(iter(pids().items()))
        os.kill(pid, signal.SIGSTOP)
        await until_gone(backend, address, 1)
        os.kill(pid, signal.SIGCONT)
        await until_gone(backend, address, 2)

    play(scenario)


@pytest.mark.slow
def test_workers_that_leave_are_not_lost(play: Callable[[Scenario], None]) -> None:
    """A front counts the worker that is killed, and not those of a machine that ends in order."""

    async def scenario(backend: DaskBackend, pids: Pids, leave: Callable[[], None]) -> None:
        address, pid = next(iter(pids().items()))
        os.kill(pid, signal.SIGKILL)
        await until_gone(backend, address, 2)
        await until(lambda: backend.lost_workers == 1)
        # Its result is on one of them, and nobody is left to take it over.
        kept = submit(backend, light.add, 1, 1)
        assert await backend.fetch(kept) == 2
        leave()
        await until_gone(backend, address, 0)
        await until(lambda: backend.warm_workers == 0)
        assert backend.lost_workers == 1

    play(scenario)
