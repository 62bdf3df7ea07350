# SPDX-License-Identifier: Apache-2.0
"""The commands and settings of the chart's pods, run on this machine, make one service."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest
import yaml
from tests.free_port import free_port
from tests.http_client import HTTP

from pugeo_client import Client

helm = pytest.importorskip("helm_python", reason="make test-deploy installs Helm's library")

START_S = 240.0
PUGEO = "from pugeo_model.cli import main; main()"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@dataclass(frozen=True)
class Cluster:
    """Address of the front, the command of the worker, and ports instead of the chart's."""

    url: str
    worker: psutil.Process
    ports: dict[int, int]


@pytest.fixture
def cluster(root: Path, tmp_path: Path, _kernels: None) -> Iterator[Cluster]:
    """Scheduler, worker and front as the chart starts them; only ports and folders differ."""
    folders = {f"/{name}": tmp_path / name for name in ("certificates", "spool", "jobs")}
    for folder in folders.values():
        folder.mkdir()
    make = [sys.executable, str(root / "deploy/make_certs.py"), str(folders["/certificates"])]
    subprocess.run(make, check=True)
    ports = {number: free_port() for number in (8000, 8786, 8788, 9100)}
    ports[8789] = ports[8788] + 1  # as `pugeo worker` has it

    def here(text: str) -> str:
        text = text.replace("/certificates", str(folders["/certificates"]))
        text = text.replace("/var/spool/pugeo", str(folders["/spool"]))
        text = text.replace("pugeo-scheduler:", "127.0.0.1:").replace("0.0.0.0", "127.0.0.1")  # noqa: S104 - not here
        for number, port in ports.items():
            text = text.replace(str(number), str(port))
        return text

    with helm.Chart.load(root / "deploy/chart") as chart:
        files = chart.render({"settings": {"PUGEO_MAX_POINTS": "5000"}}, name="pugeo")
    pods: dict[str, dict[str, Any]] = {}
    for name in ("scheduler", "worker", "front"):
        deployment = next(yaml.safe_load_all(files[f"pugeo/templates/{name}.yaml"]))
        (pods[name],) = deployment["spec"]["template"]["spec"]["containers"]
    settings = yaml.safe_load(files["pugeo/templates/settings.yaml"])["data"]
    settings |= {"PUGEO_PORT": "8000", "PUGEO_HOST": "0.0.0.0"}  # noqa: S104 - of the image
    settings |= {"PUGEO_SPOOL_DIR": "/var/spool/pugeo"}
    settings |= {"PUGEO_JOBS_DIR": str(folders["/jobs"])}

    with contextlib.ExitStack() as opened:
        log = opened.enter_context((tmp_path / "log").open("wb"))

        def start(command: list[str], environment: dict[str, str]) -> psutil.Process:
            words = [here(word) for word in command]
            if words[0] == "pugeo":
                words = [sys.executable, "-c", PUGEO, *words[1:]]
            else:
                words[0] = sys.executable
            given = {name: here(value) for name, value in environment.items()}
            process = subprocess.Popen(words, env={**os.environ, **given}, stdout=log, stderr=log)
            opened.callback(end, process)
            return psutil.Process(process.pid)

        for name in ("scheduler", "worker"):
            environment = {each["name"]: str(each["value"]) for each in pods[name]["env"]}
            found = start(pods[name]["command"], environment)
        start(["python", "-m", "pugeo_service"], settings)
        cluster = Cluster(f"http://127.0.0.1:{ports[8000]}", found, ports)
        try:
            wait_until(lambda: ready(cluster.url))
        except TimeoutError:
            pytest.fail((tmp_path / "log").read_text("utf-8")[-4000:])
        yield cluster


def end(process: subprocess.Popen[bytes]) -> None:
    for child in psutil.Process(process.pid).children(recursive=True):
        with contextlib.suppress(psutil.Error):
            child.kill()
    process.kill()
    process.wait()


def ready(url: str) -> bool:
    with contextlib.suppress(httpx2.HTTPError):
        return bool(HTTP.get(f"{url}/health/ready").status_code == 200)
    return False


def wait_until(true: Callable[[], bool]) -> None:
    until = time.monotonic() + START_S
    while not true():
        if time.monotonic() > until:
            raise TimeoutError
        time.sleep(0.1)


def workers(cluster: Cluster) -> list[str]:
    """Lines of the metrics that tell the memory of a worker."""
    text = HTTP.get(f"http://127.0.0.1:{cluster.ports[9100]}/metrics").text
    return [line for line in text.splitlines() if line.startswith("pugeo_worker_memory_bytes{")]


def test_it_serves_and_replaces_its_worker(cluster: Cluster, sphere: Any) -> None:
    """A cloud comes back, the metrics tell the worker, and a killed one returns at its port."""
    with Client(cluster.url) as client:
        assert client.upsample(sphere, ratio=4).points.shape == (2_400, 3)
        address = f"tls://127.0.0.1:{cluster.ports[8788]}"
        wait_until(lambda: any(address in line for line in workers(cluster)))
        listening = {
            each.laddr.port
            for process in (cluster.worker, *cluster.worker.children(recursive=True))
            for each in process.net_connections("tcp")
            if each.status == psutil.CONN_LISTEN
        }
        assert {cluster.ports[8788], cluster.ports[8789]} <= listening
        (process,) = [
            child
            for child in cluster.worker.children()
            if "spawn_main" in " ".join(child.cmdline())
        ]
        process.kill()
        process.wait()
        wait_until(lambda: not ready(cluster.url))
        wait_until(lambda: ready(cluster.url))
        assert client.upsample(sphere, ratio=4).points.shape == (2_400, 3)
        wait_until(lambda: any(address in line for line in workers(cluster)))
