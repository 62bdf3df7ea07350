# SPDX-License-Identifier: Apache-2.0
"""A worker of another version is given no task, and the log names both versions."""

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import distributed
import pytest
import structlog
from tests.service.engine import foreign_version
from tests.service.engine import light_stages as light
from tests.service.engine.light_tasks import submit, until, until_quick, warm

from pugeo_service import __version__
from pugeo_service.engine.dask_backend import DaskBackend
from pugeo_service.engine.dask_config import mutual_tls, scheduler_options
from pugeo_service.engine.scheduler_host import VersionedScheduler
from pugeo_service.settings import Settings

pytestmark = pytest.mark.slow

Scenario = Callable[["Cluster"], Awaitable[None]]


class Cluster:
    """A scheduler, workers in this process, and a front, over mutual TLS."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.scheduler: Any = None
        self.backend = DaskBackend(settings)
        self.workers: list[Any] = []

    async def join(self, preload: Any) -> Any:
        """Let a worker join; its preload decides on its version."""
        kind: Any = distributed.Worker
        worker = await kind(
            self.scheduler.address,
            nthreads=1,
            security=mutual_tls(self.settings),
            preload=[preload.__name__],
            dashboard_address="127.0.0.1:0",
        )
        self.workers.append(worker)
        return worker

    async def is_waiting(self, handle: Any) -> None:
        """Wait until the scheduler has found no worker for a task."""
        await until(lambda: getattr(self._task(handle), "state", "") == "no-worker")

    def _task(self, handle: Any) -> Any:
        return self.scheduler.tasks.get(handle.key)


@pytest.fixture
def play(tmp_path: Path, root: Path) -> Callable[[Scenario], None]:
    """Run a scenario in a cluster without workers."""
    subprocess.run([sys.executable, root / "deploy/make_certs.py", tmp_path], check=True)
    files: dict[str, Any] = {
        f"tls_{name}": tmp_path / f"{name}.pem" for name in ("ca", "cert", "key")
    }

    @asynccontextmanager
    async def opened() -> AsyncIterator[Cluster]:
        settings = Settings(scheduler="tls://127.0.0.1:0", spool_dir=tmp_path, **files)
        scheduler: Any = VersionedScheduler(
            host=settings.scheduler,
            security=mutual_tls(settings),
            dashboard_address="127.0.0.1:0",
            **scheduler_options(),
        )
        async with scheduler:
            cluster = Cluster(settings.model_copy(update={"scheduler": scheduler.address}))
            cluster.scheduler = scheduler
            try:
                yield cluster
            finally:
                await cluster.backend.stop()
                for worker in cluster.workers:
                    await worker.close()

    async def run(scenario: Scenario) -> None:
        async with opened() as cluster:
            await scenario(cluster)

    return lambda scenario: asyncio.run(run(scenario))


def test_a_worker_of_another_version_is_not_used(play: Callable[[Scenario], None]) -> None:
    """Its tasks wait, quick ones too, until a worker of this version joins."""

    async def scenario(cluster: Cluster) -> None:
        backend = cluster.backend
        other = await cluster.join(foreign_version)
        with structlog.testing.capture_logs() as logs:
            await backend.start()
            assert backend.warm_workers == 0
            tasks = [submit(backend, light.add, 1, 1), submit(backend, light.add_quickly, 1, 1)]
            for task in tasks:
                await cluster.is_waiting(task)
            ours = await cluster.join(light)
            assert [await backend.fetch(task) for task in tasks] == [2, 2]
            await warm(backend, 1)
        assert backend.worker_names == (ours.address,)
        assert set(other.data) == set()
        wanted = f"{other.address} runs pugeo 0.0.9, this service {__version__}: it is not used"
        assert [log for log in logs if wanted in log["event"]] == logs[:1]

    play(scenario)


def test_a_lost_place_is_not_taken_by_another_version(
    play: Callable[[Scenario], None],
) -> None:
    """A task with a place on a worker that is gone waits for one of its own version."""

    async def scenario(cluster: Cluster) -> None:
        backend = cluster.backend
        ours = await cluster.join(light)
        other = await cluster.join(foreign_version)
        await backend.start()
        gone = ours.address
        await ours.close()
        await until(lambda: gone not in cluster.scheduler.workers)
        placed = backend.submit(light.add, 1, 1, priority=0, seconds=60, long=False, worker=gone)
        await cluster.is_waiting(placed)
        await cluster.join(light)
        assert await backend.fetch(placed) == 2
        assert set(other.data) == set()

    play(scenario)


def test_quick_stages_do_not_wait(play: Callable[[Scenario], None], tmp_path: Path) -> None:
    """A quick stage overtakes stages that wait for the core, on workers of another machine too."""

    async def scenario(cluster: Cluster) -> None:
        backend, gate, log = cluster.backend, tmp_path / "gate", tmp_path / "log"
        await cluster.join(light)
        await backend.start()
        held = [submit(backend, light.hold, str(gate), str(log), name) for name in "ab"]
        await until(log.exists)
        await until_quick(backend)
        assert log.read_text().split() == ["a"]
        gate.touch()
        assert [await backend.fetch(each) for each in held] == ["a", "b"]

    play(scenario)
