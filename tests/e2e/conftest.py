# SPDX-License-Identifier: Apache-2.0
"""A real service in a separate process, with real workers and real weights."""

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from tests.http_client import HTTP

# Comes with Dask, without types.
psutil: Any = importlib.import_module("psutil")

_READY_S = 200.0
# The small network: other tests ask the large one whether its points are right.
_FAST = {"PUGEO_MODEL": "fast"}
_SLOW_SERVICE = Path(__file__).with_name("slow_service.py")


@dataclass(frozen=True)
class Server:
    """A running service.

    Attributes:
        url: base URL.
        process: front process.
        log: file with its stderr.
    """

    url: str
    process: "subprocess.Popen[str]"
    log: Path

    def workers(self) -> list[Any]:
        """The running worker processes."""
        children = psutil.Process(self.process.pid).children()
        return [child for child in children if "spawn_main" in " ".join(_command(child))]

    def wait_until_started(self, seconds: float = 60.0) -> None:
        """Wait until a worker process exists, which is before the service is ready."""
        end = time.monotonic() + seconds
        while not self.workers():
            assert self.process.poll() is None, self.log.read_text()[-4000:]
            assert time.monotonic() < end, "no worker process"
            time.sleep(0.02)

    def wait_until_ready(self, seconds: float = _READY_S) -> None:
        """Wait until /health/ready answers 200."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.process.poll() is None:
            if HTTP.get(f"{self.url}/health/ready", timeout=60).status_code == 200:
                return
            time.sleep(0.1)
        pytest.fail(f"not ready after {seconds:g} s:\n{self.log.read_text()[-4000:]}")

    def wait_until_working(self, seconds: float = 100.0) -> None:
        """Wait until patches of an admitted request were finished and others remain."""
        end, most = time.monotonic() + seconds, 0.0
        while not 0 < (left := self.patches()) < most:
            assert time.monotonic() < end, f"{left} of {most} patches left"
            most = max(most, left)
            time.sleep(0.02)

    def patches(self) -> float:
        """Patches of requests and jobs that are admitted and not finished."""
        queues = ("requests", "jobs")
        return sum(self.metric(f'pugeo_queue_patches{{queue="{queue}"}}') for queue in queues)

    def metric(self, sample: str) -> float:
        """Value of a sample of /metrics, 0 if it does not exist yet."""
        for line in HTTP.get(f"{self.url}/metrics", timeout=60).text.splitlines():
            name, _, value = line.rpartition(" ")
            if name == sample:
                return float(value)
        return 0.0

    def stop(self, seconds: float = 100.0) -> int:
        """Send SIGTERM and return the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(seconds)


def _command(process: Any) -> list[str]:
    try:
        return list(process.cmdline())
    except psutil.Error:
        return []


@contextmanager
def launched(log: Path, *options: str, **environment: str) -> Iterator[Server]:
    """Start a service and end it after the block.

    Args:
        log: file for its stderr.
        options: command line options.
        environment: additional environment variables; ``SLOW_S`` stands for the seconds that the
            network takes at least for each patch of a cloud.
    """
    program = [str(_SLOW_SERVICE)] if "SLOW_S" in environment else ["-m", "pugeo_service"]
    command = [sys.executable, *program, "--port", "0", *options]
    with log.open("w") as stderr:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            process_group=0,  # as a shell starts it
            env={**os.environ, "PUGEO_WORKERS": "2", "PUGEO_LOG_FORMAT": "json", **environment},
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("pugeo serves http://"), line + log.read_text()[-4000:]
        yield Server(line.split()[-1], process, log)
    finally:
        process.terminate()
        try:
            process.wait(30)
        finally:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


@pytest.fixture
def launch(_kernels: None, tmp_path: Path) -> Callable[..., AbstractContextManager[Server]]:
    """Starts a separate service: ``with launch("--workers", "1", SLOW_S="0.1") as server``."""
    return partial(launched, tmp_path / "server.log", **_FAST)


@pytest.fixture(scope="module")
def inline(_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service of threads, with the limits that are the default."""
    with launched(
        tmp_path_factory.mktemp("inline") / "server.log", "--engine", "inline", **_FAST
    ) as running:
        running.wait_until_ready()
        yield running


@pytest.fixture(scope="module")
def slow_server(_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service whose two workers take 0.4 s for each patch, with 32 MiB a body."""
    limits = ("--max-body-bytes", str(32 << 20), "--max-points", "300000")
    with launched(
        tmp_path_factory.mktemp("slow") / "server.log", *limits, SLOW_S="0.4", **_FAST
    ) as running:
        running.wait_until_ready()
        yield running


@pytest.fixture(scope="session")
def server(_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service that most tests share: 32 MiB a body, a folder of models, a canary."""
    folder = tmp_path_factory.mktemp("service")
    log, models = folder / "server.log", folder / "models"
    models.mkdir()
    limits = ("--max-body-bytes", str(32 << 20), "--max-points", "300000")
    offered = {"PUGEO_MODELS_DIR": str(models), "PUGEO_CANARY": "standard:0"}
    with launched(log, *limits, **offered, **_FAST) as running:
        running.wait_until_ready()
        yield running
        assert running.stop() == 0, log.read_text()[-4000:]
