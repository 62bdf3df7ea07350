# SPDX-License-Identifier: Apache-2.0
"""The jobs API with a real database and real files, and a fake engine."""

import asyncio
import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from tests.free_port import free_port

from pugeo_model.errors import MalformedFileError
from pugeo_service import app as app_module
from pugeo_service.app import create_app
from pugeo_service.engine import EngineLostError, ModelId, RunRequest, RunResult, WorkerLostError
from pugeo_service.engine.engine import Status
from pugeo_service.engine.errors import disk_errors
from pugeo_service.jobs.manager import JobManager
from pugeo_service.settings import Settings
from pugeo_service.storage.spool import Spool

WAIT_S = 60.0  # a limit for conditions that hold within milliseconds on an idle machine
REPORT = {
    "points_in": 4,
    "points_out": 8,
    "dropped": {"non_finite": 1, "duplicate": 2},
    "notes": [],
}


class FakeEngine:
    """Fake engine: a deterministic answer in four patches.

    ``hold`` delays the end of all runs; the body selects an error.
    """

    def __init__(self, settings: Settings, model: ModelId) -> None:
        del model
        self.settings = settings
        self.hold = asyncio.Event()
        self.hold.set()
        self.began: list[bytes] = []
        self.orders: list[RunRequest] = []
        self.running = 0
        self.most_running = 0
        self.lose = 0
        self.workers = 2

    @property
    def status(self) -> Status:
        return Status(workers=self.workers, expected=2, lost=0, retried=0)

    async def start(self) -> None:
        pass

    async def stop(self) -> None:
        pass

    async def run(
        self,
        body: Any,
        order: RunRequest,
        *,
        on_patches: Callable[[int], object],
        on_done: Callable[[int], object],
        on_stage: Callable[[str], object] = lambda _: None,
    ) -> RunResult:
        with disk_errors():
            data = (await body.read()).tobytes()
        self.began.append(data)
        self.orders.append(order)
        self.running += 1
        self.most_running = max(self.running, self.most_running)
        try:
            on_stage("prepare")
            on_patches(4)
            on_stage("predict")
            on_done(1)
            await self.hold.wait()
            self._go_wrong(data)
            on_done(3)
            on_stage("finish")
        finally:
            self.running -= 1
        spool = Spool(self.settings.spool_dir)
        await spool.write(b"dense " + data * 2)
        return RunResult(spool, REPORT, {"queue": 0.0, "predict": 0.5}, [(0.5, 4)])

    def _go_wrong(self, data: bytes) -> None:
        if data.startswith(b"malformed"):
            raise MalformedFileError("it is broken", code="malformed_file", row=7)
        if data.startswith(b"poison"):
            raise WorkerLostError("it ended two workers")
        if data.startswith(b"bug"):
            raise ZeroDivisionError
        if self.lose:
            self.lose -= 1
            raise EngineLostError("the scheduler is gone")


class House:
    """One running service.

    Attributes:
        http: client of the service.
        engine: its fake engine.
        jobs: its job manager.
        folder: folder of jobs.
    """

    def __init__(
        self, http: httpx2.AsyncClient, engine: FakeEngine, jobs: JobManager, folder: Path
    ) -> None:
        self.http = http
        self.engine = engine
        self.jobs = jobs
        self.folder = folder

    async def submit(self, body: bytes = b"cloud", query: str = "?R=2", **headers: str) -> Any:
        """Submit a job and return its JSON."""
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        answer = await self.http.post(f"/jobs{query}", content=body, headers=named)
        assert answer.status_code == 202, answer.text
        return answer.json()

    async def until_open(self) -> None:
        """Wait until jobs are accepted."""
        await self.until_status("/jobs", 200)

    async def get(self, job_id: str) -> Any:
        """The JSON of a job."""
        answer = await self.http.get(f"/jobs/{job_id}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    async def until(self, job_id: str, *states: str) -> Any:
        """Wait until a job is in one of some states."""
        end = time.monotonic() + WAIT_S
        while (job := await self.get(job_id))["state"] not in states:
            assert time.monotonic() < end, job
            await asyncio.sleep(0.01)
        return job

    async def eventually(self, check: Callable[[], bool]) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + WAIT_S
        while not check():
            assert time.monotonic() < end
            await asyncio.sleep(0.01)

    async def until_status(self, path: str, status: int) -> Any:
        """Repeat a GET until it has a status; return the answer."""
        end = time.monotonic() + WAIT_S
        while (answer := await self.http.get(path)).status_code != status:
            assert time.monotonic() < end, answer.text
            await asyncio.sleep(0.01)
        return answer

    def names(self, folder: str) -> list[str]:
        """The names of the files in one of the folders."""
        return sorted(path.name for path in (self.folder / folder).iterdir())


Open = Callable[..., Any]


@pytest.fixture
def open_house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, database_url: str | None) -> Open:
    """Start a service: ``async with open_house(jobs_running=1) as house``; again for a restart."""
    monkeypatch.setattr(app_module, "Engine", FakeEngine)
    monkeypatch.setattr("pugeo_service.jobs.runner._POLL_S", 0.05)
    monkeypatch.setattr("pugeo_service.jobs.webhooks._POLL_S", 0.05)
    monkeypatch.setattr("pugeo_service.jobs.runner._PROGRESS_S", 0.02)
    monkeypatch.setattr("pugeo_service.jobs.maintenance._INTERVAL_S", 0.05)
    monkeypatch.setattr("pugeo_service.jobs.completion._DATABASE_RETRY_S", 0.05)
    monkeypatch.setattr("pugeo_service.jobs.clock._SETTLE_S", 0.0)

    @asynccontextmanager
    async def opened(**settings: Any) -> AsyncIterator[House]:
        spool = tmp_path / "spool"
        spool.mkdir(exist_ok=True)
        given = {"spool_dir": spool, "jobs_dir": tmp_path / "jobs", "database_url": database_url}
        chosen = Settings(**(given | settings))
        app = create_app(chosen)
        transport = httpx2.ASGITransport(app=app)
        lifespan = app.router.lifespan_context(app)
        await lifespan.__aenter__()
        try:
            async with httpx2.AsyncClient(transport=transport, base_url="http://test") as http:
                service = app.state.service
                yield House(http, service.engine, service.jobs, chosen.jobs_folder)
        finally:
            # As a server does, also after a failed test.
            await lifespan.__aexit__(None, None, None)

    return opened


@pytest.fixture
def play(open_house: Open) -> Callable[..., None]:
    """Run a scenario against one service: ``play(scenario, jobs_queue=2)``."""

    def run(scenario: Callable[[House], Awaitable[None]], **settings: Any) -> None:
        async def whole() -> None:
            async with open_house(**settings) as house:
                await scenario(house)

        asyncio.run(whole())

    return run


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def database_url(request: pytest.FixtureRequest) -> str | None:
    """URL of the database: SQLite in the folder of jobs (``None``), or an empty PostgreSQL one."""
    if request.param == "sqlite":
        return None
    return str(request.getfixturevalue("postgres")())


def _programs() -> Path | None:
    """The folder of PostgreSQL's programs, if it is installed."""
    for found in (
        shutil.which("initdb"),
        *sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb")),
    ):
        if found is not None:
            return Path(found).resolve().parent
    return None


@pytest.fixture(scope="session")
def postgres() -> Iterator[Callable[[], str]]:
    """A PostgreSQL server of its own; call it for the URL of an empty database."""
    programs = _programs()
    if os.environ.get("PUGEO_TEST_POSTGRES") != "1":
        pytest.skip("make test-postgres runs it")
    if programs is None:
        pytest.skip("PostgreSQL is not installed: there is no initdb")
    # It refuses to run as root.
    user = "nobody" if os.geteuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="pugeo-postgres-"))
    if user is not None:
        os.chown(folder, pwd.getpwnam(user).pw_uid, -1)
    port = free_port()
    data = str(folder / "data")

    def run(program: str, *arguments: str) -> None:
        command = [str(programs / program), *arguments]
        subprocess.run(command, check=True, user=user, stdout=subprocess.DEVNULL, cwd=folder)

    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1 -c fsync=off"
    run("initdb", "-D", data, "-U", "pugeo", "--auth=trust", "--no-sync")
    try:
        run("pg_ctl", "-D", data, "-o", options, "-l", str(folder / "log"), "-w", "start")
        made = 0

        def empty() -> str:
            nonlocal made
            made += 1
            arguments = ["-h", "127.0.0.1", "-p", str(port), "-U", "pugeo", f"jobs{made}"]
            subprocess.run([programs / "createdb", *arguments], check=True)
            return f"postgresql://pugeo@127.0.0.1:{port}/jobs{made}"

        yield empty
        run("pg_ctl", "-D", data, "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder)
