# SPDX-License-Identifier: Apache-2.0
"""The built image, run as uid 10001 on a read-only root; `make image` builds it first."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from pugeo_client import Client

UID = 10001
MOST_BYTES = 1_000_000_000
START_S = 240.0
IMAGE = "localhost/pugeo:latest"

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@dataclass(frozen=True)
class Image:
    """The unpacked image and what its configuration says.

    Attributes:
        folder: its root.
        config: ``Env``, ``Cmd``, ``User`` and so on.
        store: folder of the builder.
    """

    folder: Path
    config: dict[str, Any]
    store: Path


@pytest.fixture(scope="module")
def image(root: Path) -> Iterator[Image]:
    """The image that `make image` built."""
    missing = [name for name in ("buildah", "bwrap") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        pytest.skip(f"needs root and {', '.join(missing)} (apt-get install buildah bubblewrap)")
    store = root / ".cache/image"
    command = ["buildah", "--root", str(store / "storage"), "--runroot", str(store / "run")]

    def buildah(*arguments: str) -> str:
        done = subprocess.run(
            [*command, *arguments], check=True, capture_output=True, text=True
        ).stdout
        return done.strip()

    if not (store / "storage").exists() or IMAGE not in buildah(
        "images", "--format", "{{.Name}}:{{.Tag}}"
    ):
        pytest.skip("there is no image; `make image` builds it")
    container = buildah("from", "--pull-never", IMAGE)
    try:
        described = json.loads(buildah("inspect", "--type", "image", IMAGE))
        folder = Path(buildah("mount", container))
        yield Image(folder, described["Docker"]["config"], store)
    finally:
        buildah("rm", container)


class Host:
    """Runs commands of the image as a container engine does, on this machine's network.

    The root is read-only, the user is that of the image without capabilities, and the folders that
    the image names for data are volumes.
    """

    def __init__(self, image: Image, volumes: Path, port: int) -> None:
        self._image = image
        self.port = port
        self._volumes = {}
        for path in ("/var/cache/pugeo", "/var/lib/pugeo", "/var/spool/pugeo"):
            volume = volumes / path.replace("/", "_")
            # A new volume takes over the content of its folder, and its owner.
            shutil.copytree(image.folder / path[1:], volume)
            for each in (volume, *volume.rglob("*")):
                os.chown(each, UID, UID)
            self._volumes[path] = volume

    def command(self, words: list[str]) -> list[str]:
        """Return the command that runs words in the container."""
        bwrap = ["bwrap", "--ro-bind", str(self._image.folder), "/"]
        bwrap += ["--proc", "/proc", "--dev", "/dev"]
        for path in ("/tmp", "/dev/shm"):  # noqa: S108 - folders of the container
            bwrap += ["--perms", "1777", "--tmpfs", path]
        for path, volume in self._volumes.items():
            bwrap += ["--bind", str(volume), path]
        bwrap += ["--unshare-pid", "--unshare-ipc", "--as-pid-1", "--die-with-parent", "--clearenv"]
        environment = dict(line.split("=", 1) for line in self._image.config["Env"])
        environment |= {"PUGEO_PORT": str(self.port), "PUGEO_HOST": "127.0.0.1"}
        environment |= {"PUGEO_WORKERS": "1"}
        for name, value in environment.items():
            bwrap += ["--setenv", name, value]
        bwrap += ["--chdir", self._image.config["WorkingDir"], "--", "setpriv"]
        bwrap += [f"--reuid={UID}", f"--regid={UID}", "--clear-groups", "--no-new-privs"]
        return [*bwrap, "--bounding-set=-all", "--inh-caps=-all", "--", *words]

    def run(self, words: list[str]) -> subprocess.CompletedProcess[str]:
        """Run words to their end."""
        return subprocess.run(self.command(words), check=False, capture_output=True, text=True)


@pytest.fixture(scope="module")
def host(
    image: Image, tmp_path_factory: pytest.TempPathFactory, free_port: Callable[[], int]
) -> Host:
    volumes = tmp_path_factory.mktemp("volumes")
    for parent in (volumes, *volumes.parents[:2]):
        parent.chmod(0o755)  # the volumes are below folders of root
    return Host(image, volumes, free_port())


@dataclass(frozen=True)
class Running:
    """The service in its container."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path

    def first(self) -> psutil.Process:
        """Process 1 of the container."""
        (found,) = psutil.Process(self.process.pid).children()
        return found


@pytest.fixture
def service(image: Image, host: Host, tmp_path: Path) -> Iterator[Running]:
    """The command of the image, once it is ready."""
    log = tmp_path / "log"
    with log.open("wb") as stream:
        command = host.command(image.config["Cmd"])
        process = subprocess.Popen(command, stdout=stream, stderr=stream)
        try:
            running = Running(f"http://127.0.0.1:{host.port}", process, log)
            end = time.monotonic() + START_S
            while not is_ready(running.url):
                assert process.poll() is None, log.read_text("utf-8")
                assert time.monotonic() < end, log.read_text("utf-8")
                time.sleep(0.2)
            yield running
        finally:
            # The end of process 1 is that of its container; bwrap's own end is not, because a
            # change of the user clears the signal that it asked for.
            for first in psutil.Process(process.pid).children() if process.poll() is None else ():
                first.kill()
            process.wait(60)


def is_ready(url: str) -> bool:
    with contextlib.suppress(httpx2.HTTPError):
        return bool(httpx2.get(f"{url}/health/ready").status_code == 200)
    return False


def sphere(points: int) -> NDArray[np.float32]:
    drawn = np.random.default_rng(1).normal(size=(points, 3))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    return drawn.astype(np.float32)


def test_it_is_small(image: Image) -> None:
    """The compressed layers have less than 1.0 GB."""
    blobs = [path for path in (image.store / "oci/blobs").rglob("*") if path.is_file()]
    assert len(blobs) >= 3
    assert sum(path.stat().st_size for path in blobs) < MOST_BYTES


def test_it_has_no_more_than_it_needs(image: Image) -> None:
    """Its user is not root, and neither compilers, pip nor tests are in it."""
    assert image.config["User"] == f"{UID}:{UID}"
    assert image.config["StopSignal"] in {"SIGTERM", "15"}
    for program in ("pip", "pip3", "gcc", "hatchling"):
        assert not list(image.folder.glob(f"opt/venv/bin/{program}"))
    packages = next((image.folder / "opt/venv/lib").glob("python3*/site-packages"))
    assert (packages / "torch").is_dir()
    assert not (packages / "torch/test").exists()
    assert not (packages / "torch/include").exists()


def test_its_root_is_read_only(host: Host) -> None:
    """No file can be made outside of the volumes and /tmp."""
    code = (
        "import os, pathlib\n"
        "assert os.getuid() == 10001\n"
        "for name in ('/x', '/opt/venv/x', '/etc/x'):\n"
        "    try: pathlib.Path(name).touch()\n"
        "    except OSError as error: assert error.errno == 30, error\n"
        "    else: raise SystemExit(name)\n"
        "for name in ('/tmp/x', '/var/spool/pugeo/x', '/var/lib/pugeo/x'):\n"
        "    pathlib.Path(name).touch()\n"
        "    pathlib.Path(name).unlink()\n"
    )
    done = host.run(["python", "-c", code])
    assert done.returncode == 0, done.stderr


def test_it_upsamples_and_is_healthy(image: Image, host: Host, service: Running) -> None:
    """A cloud gets four times its points, the health check passes, and no process is root's."""
    with Client(service.url) as client:
        dense = client.upsample(sphere(2_000), ratio=4)
    assert dense.points.shape == (8_000, 3)
    assert np.abs(np.linalg.norm(dense.points, axis=1) - 1).max() < 0.05
    check = image.config["Healthcheck"]["Test"]
    assert check[0] == "CMD"
    assert host.run(check[1:]).returncode == 0
    first = service.first()
    for process in (first, *first.children(recursive=True)):
        assert process.uids().real == UID
    # The kernels are those of the image.
    assert "compiling kernels" not in service.log.read_text("utf-8")


def test_it_drains(service: Running) -> None:
    """On SIGTERM it answers what it accepted, takes no more, and ends with status 0."""
    answers: list[int] = []

    def ask() -> None:
        with Client(service.url, timeout=300) as client:
            answers.append(len(client.upsample(sphere(60_000), ratio=4).points))

    thread = threading.Thread(target=ask)
    thread.start()
    while httpx2.get(f"{service.url}/health").json()["queue_patches"] == 0:
        assert thread.is_alive()
        time.sleep(0.02)
    assert answers == []
    service.first().send_signal(signal.SIGTERM)
    thread.join()
    assert answers == [240_000]
    assert service.process.wait(60) == 0
    assert not is_ready(service.url)
