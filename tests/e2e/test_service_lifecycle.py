# SPDX-License-Identifier: Apache-2.0
"""Life cycle of a service: start, full queue, drain, end, external cluster."""

import io
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.free_port import free_port
from tests.http_client import HTTP

from pugeo_model import Cloud, formats

pytestmark = pytest.mark.slow


def ball(count: int) -> bytes:
    """A sphere of so many points, as a PLY file."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    buffer = io.BytesIO()
    formats.write(Cloud(sphere.astype(np.float32)), buffer, format="ply")
    return buffer.getvalue()


# A slow service is busy with the large one for seconds.
SMALL, LARGE = ball(1000), ball(20_000)
PUGEO = "from pugeo_model.cli import main; main()"


class Post(threading.Thread):
    """A request in the background."""

    def __init__(self, url: str, body: bytes) -> None:
        super().__init__()
        self._url = url
        self._body = body
        self.response: httpx2.Response | None = None

    def run(self) -> None:
        """Send it and wait."""
        self.response = HTTP.post(f"{self._url}/upsample?R=2", content=self._body, timeout=300)


def begun(server: Any, body: bytes) -> Post:
    """A request that was admitted."""
    post = Post(server.url, body)
    post.start()
    while server.metric('pugeo_queue_patches{queue="requests"}') == 0:
        time.sleep(0.02)
    return post


def test_sigterm_drains(launch: Any) -> None:
    """After SIGTERM new requests are refused and admitted ones finished; status 0."""
    options = ("--workers", "1", "--drain-s", "300")
    with launch(*options, SLOW_S="0.5", PUGEO_DRAIN_DELAY_S="4") as server:
        server.wait_until_ready()
        accepted = begun(server, LARGE)
        server.process.send_signal(signal.SIGTERM)
        while (ready := HTTP.get(f"{server.url}/health/ready", timeout=60)).status_code == 200:
            time.sleep(0.02)
        assert (ready.status_code, ready.json()["code"]) == (503, "draining")
        assert HTTP.get(f"{server.url}/health/live", timeout=60).status_code == 200
        refused = HTTP.post(f"{server.url}/upsample", content=SMALL, timeout=60)
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")
        assert "retry-after" in refused.headers
        assert server.process.wait(400) == 0
        accepted.join()
        assert accepted.response is not None
        assert accepted.response.status_code == 200
        assert accepted.response.headers["pugeo-points-out"] == "40000"


@pytest.mark.parametrize(
    "moment",
    [0.0, 1.2, *(pytest.param(at, marks=pytest.mark.long) for at in (0.6, 2.4))],
)
def test_sigterm_while_starting(launch: Any, moment: float) -> None:
    """SIGTERM before the service is ready ends it with status 0."""
    with launch("--workers", "1") as server:
        assert HTTP.get(f"{server.url}/health/live", timeout=60).status_code == 200
        ready = HTTP.get(f"{server.url}/health/ready", timeout=60)
        assert (ready.status_code, ready.json()["code"]) == (503, "no_worker")
        assert HTTP.get(f"{server.url}/health", timeout=60).json()["status"] == "not_ready"
        refused = HTTP.post(f"{server.url}/upsample", content=SMALL, timeout=60)
        assert (refused.status_code, refused.json()["code"]) == (503, "no_worker")
        time.sleep(moment)
        assert server.stop() == 0
        assert "Traceback" not in server.log.read_text()


def test_full_and_late(launch: Any) -> None:
    """A full queue gives 503 with Retry-After, a passed deadline 504; then it goes on."""
    options = ("--queue-requests", "1", "--deadline-s", "6", "--workers", "1")
    with launch(*options, SLOW_S="0.8") as server:
        server.wait_until_ready()
        late = begun(server, LARGE)
        full = HTTP.post(f"{server.url}/upsample", content=SMALL, timeout=60)
        assert (full.status_code, full.json()["code"]) == (503, "queue_full")
        assert 1 <= int(full.headers["retry-after"]) <= 120
        assert full.json()["retryable"] is True
        late.join()
        assert late.response is not None
        assert late.response.status_code == 504
        assert late.response.json()["code"] == "deadline_exceeded"
        assert server.metric('pugeo_cancelled_total{reason="deadline"}') == 1
        assert server.metric('pugeo_rejected_total{reason="queue_full"}') == 1
        assert server.metric('pugeo_queue_patches{queue="requests"}') == 0
        good = HTTP.post(f"{server.url}/upsample?R=2", content=SMALL, timeout=60)
        assert good.status_code == 200


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--model", "nothing"], 2, "no weights 'nothing'"),
        (["--engine", "magic"], 2, "PUGEO_ENGINE=magic: "),
    ],
)
def test_wrong_settings(options: list[str], status: int, words: str) -> None:
    """A wrong setting gives a line on stderr and status 2."""
    command = [sys.executable, "-m", "pugeo_service", "--port", "0", *options]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert ended.returncode == status, ended.stderr
    assert words in ended.stderr
    assert "Traceback" not in ended.stderr
    assert ended.stdout == ""


def test_a_port_that_is_taken() -> None:
    """A port in use gives a log line and status 1."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "pugeo_service", "--port", port]
        ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1
    assert "cannot listen" in ended.stderr


def test_workers_that_cannot_start(launch: Any) -> None:
    """If no worker can start, for lack of memory, the service says so and ends with status 1."""
    # The front needs 0.7 GB of address space, a worker more than 1 GB.
    limits = (1_000_000_000, 1_000_000_000)
    with launch("--workers", "1", PUGEO_START_S="100") as server:
        resource.prlimit(server.process.pid, resource.RLIMIT_AS, limits)
        assert server.process.wait(300) == 1
        last = [line for line in server.log.read_text().splitlines() if "cannot start" in line]
        assert "about 1 GB of memory and address space" in last[-1] or "kernels" in last[-1]


def test_ctrl_c_before_ready(launch: Any) -> None:
    """An interrupt of the whole process group ends a service that starts, without a traceback."""
    with launch("--workers", "1") as server:
        server.wait_until_started()
        os.killpg(server.process.pid, signal.SIGINT)
        assert server.process.wait(100) == 0
        assert "Traceback" not in server.log.read_text()
        assert "KeyboardInterrupt" not in server.log.read_text()


def points(data: bytes) -> NDArray[Any]:
    """The points of a PLY file."""
    return formats.read(io.BytesIO(data), format="ply").points


def test_inline(launch: Any, server: Any) -> None:
    """The inline engine gives the same answers, once a line on stdout has said that it is ready."""
    with launch("--engine", "inline") as inline:
        assert inline.process.stdout.readline() == f"ready: {inline.url}\n"
        assert HTTP.get(f"{inline.url}/health/ready", timeout=60).status_code == 200
        urls = [f"{one.url}/upsample?R=2" for one in (inline, server)]
        answers = [HTTP.post(url, content=SMALL, timeout=60) for url in urls]
        assert [answer.status_code for answer in answers] == [200, 200]
        here, there = (points(answer.content) for answer in answers)
        np.testing.assert_allclose(here, there, atol=1e-6)


class ExternalCluster:
    """A scheduler and a machine with one worker, with mutual TLS."""

    def __init__(self, folder: Path, root: Path) -> None:
        subprocess.run([sys.executable, root / "deploy/make_certs.py", folder], check=True)
        self.credentials = {
            f"PUGEO_TLS_{name.upper()}": str(folder / f"{name}.pem")
            for name in ("ca", "cert", "key")
        }
        self._port = free_port()
        self.address = f"tls://127.0.0.1:{self._port}"
        self._folder = folder
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.worker: subprocess.Popen[bytes] | None = None

    def start_scheduler(self) -> None:
        """Start the scheduler."""
        self.scheduler = self._run("scheduler", "--port", str(self._port))

    def start_worker(self) -> None:
        """Start the worker."""
        options = ["--workers", "1", "--spool-dir", str(self._folder)]
        self.worker = self._run("worker", "--scheduler", self.address, *options)

    def kill_scheduler(self) -> None:
        """End the scheduler by SIGKILL."""
        assert self.scheduler is not None
        self.scheduler.kill()
        self.scheduler.wait(30)
        self.scheduler = None

    def stop(self) -> list[int]:
        """End both by SIGTERM, the worker first; return their exit statuses."""
        statuses = []
        for process in (self.worker, self.scheduler):
            if process is not None:
                process.send_signal(signal.SIGTERM)
                statuses.append(process.wait(90))
        self.worker = self.scheduler = None
        return statuses

    def _run(self, *arguments: str) -> "subprocess.Popen[bytes]":
        with (self._folder / "cluster.log").open("a") as log:
            command = [sys.executable, "-c", PUGEO, *arguments]
            environment = os.environ | self.credentials
            return subprocess.Popen(command, stdout=log, stderr=log, env=environment)


@pytest.fixture
def external(tmp_path: Path, root: Path) -> Iterator[ExternalCluster]:
    """An external cluster, not started yet."""
    cluster = ExternalCluster(tmp_path, root)
    yield cluster
    cluster.stop()


def test_an_external_cluster(external: ExternalCluster, launch: Any, server: Any) -> None:
    """PUGEO_SCHEDULER gives the same answers; the cluster runs on after the front, and ends so."""
    external.start_worker()
    external.start_scheduler()
    for _ in range(2):
        with launch("--scheduler", external.address, **external.credentials) as front:
            front.wait_until_ready()
            health = HTTP.get(f"{front.url}/health", timeout=60).json()
            assert (health["workers"], health["workers_expected"]) == (1, None)
            answer = HTTP.post(f"{front.url}/upsample?R=2", content=SMALL, timeout=60)
            assert answer.status_code == 200, answer.text
            assert front.stop() == 0
    near = HTTP.post(f"{server.url}/upsample?R=2", content=SMALL, timeout=60)
    np.testing.assert_allclose(points(answer.content), points(near.content), atol=1e-6)
    assert external.stop() == [0, 0]


@pytest.mark.long
def test_a_cluster_that_goes_away(external: ExternalCluster, launch: Any) -> None:
    """While the scheduler is gone all requests get 503, running ones too; then workers return."""
    external.start_scheduler()
    external.start_worker()
    with launch("--scheduler", external.address, **external.credentials) as front:
        front.wait_until_ready()
        waiting = begun(front, ball(50_000))
        front.wait_until_working()
        external.kill_scheduler()
        waiting.join()
        assert waiting.response is not None
        found = waiting.response.json()
        assert (found["status"], found["code"], found["retryable"]) == (503, "engine_lost", True)
        for _ in range(3):
            refused = HTTP.post(f"{front.url}/upsample", content=SMALL, timeout=60)
            assert refused.status_code == 503, refused.text
        assert HTTP.get(f"{front.url}/health/ready", timeout=60).json()["code"] == "no_worker"
        assert HTTP.get(f"{front.url}/health/live", timeout=60).status_code == 200
        external.start_scheduler()
        front.wait_until_ready()
        answer = HTTP.post(f"{front.url}/upsample?R=2", content=SMALL, timeout=60)
        assert answer.status_code == 200, answer.text
        assert front.stop() == 0
