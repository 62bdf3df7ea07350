# SPDX-License-Identifier: Apache-2.0
"""``pugeo scheduler`` and ``pugeo worker``: wrong settings end them with one line."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.free_port import free_port

from pugeo_service import cluster

PUGEO = "from pugeo_model.cli import main; main()"


@pytest.fixture
def certificates(tmp_path: Path, root: Path) -> dict[str, str]:
    """Settings of certificates that are valid."""
    subprocess.run([sys.executable, root / "deploy/make_certs.py", tmp_path], check=True)
    return {f"PUGEO_TLS_{n.upper()}": str(tmp_path / f"{n}.pem") for n in ("ca", "cert", "key")}


def run(certificates: dict[str, str], *arguments: str) -> "subprocess.Popen[str]":
    """Start a command of ours."""
    return subprocess.Popen(
        [sys.executable, "-c", PUGEO, *arguments],
        env={**os.environ, **certificates, "PUGEO_LOG_FORMAT": "json"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "PUGEO_SCHEDULER: must be tls://host:port"),
        ({"scheduler": "tcp://x:1"}, "PUGEO_SCHEDULER=tcp://x:1: must be tls://host:port"),
        ({"scheduler": "tls://x:1"}, "PUGEO_SCHEDULER needs PUGEO_TLS_CA"),
        ({"scheduler": "tls://x:1", "workers": -1}, "PUGEO_WORKERS=-1"),
        ({"worker_memory": "1kB"}, "PUGEO_WORKER_MEMORY=1kB"),
    ],
)
def test_a_worker_with_wrong_settings(
    given: dict[str, Any], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 2, and a line that names the setting."""
    assert cluster.worker_main(given, None, None) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("command", ["scheduler", "worker"])
def test_a_host_of_another_machine(
    command: str,
    certificates: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An address that is not of this machine is refused, before anything starts."""
    for name, value in certificates.items():
        monkeypatch.setenv(name, value)
    if command == "scheduler":
        status = cluster.scheduler_main({"scheduler": "tls://192.0.2.1:8786"})
    else:
        status = cluster.worker_main({"scheduler": "tls://127.0.0.1:8786"}, "192.0.2.1", None)
    (line,) = capsys.readouterr().err.splitlines()
    assert status == 2
    assert line.startswith("--host=192.0.2.1: must be an address or name of this machine")


@pytest.mark.slow
def test_a_scheduler_whose_port_is_taken(certificates: dict[str, str]) -> None:
    """Status 1, and a line that names the address."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        process = run(certificates, "scheduler", "--port", port)
        _, errors = process.communicate(timeout=100)
    assert process.returncode == 1
    (line,) = errors.splitlines()
    assert '"cannot listen"' in line
    assert f"tls://127.0.0.1:{port}" in line


@pytest.mark.slow
def test_a_scheduler_tells_its_address_and_ends(certificates: dict[str, str]) -> None:
    """Port 0 takes a free one; SIGTERM ends it with status 0."""
    process = run(certificates, "scheduler", "--port", "0")
    assert process.stdout is not None
    address = process.stdout.readline().split()[-1]
    assert address.startswith("tls://127.0.0.1:")
    socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])), 10).close()
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=100)
    assert (process.returncode, errors) == (0, "")


@pytest.mark.slow
@pytest.mark.usefixtures("_kernels")
def test_a_worker_ends_while_it_waits(certificates: dict[str, str]) -> None:
    """Without a scheduler it says why, once, and SIGTERM ends it with status 0."""
    address = f"tls://127.0.0.1:{free_port()}"
    process = run(certificates, "worker", "--scheduler", address, "--workers", "1")
    assert process.stderr is not None
    while '"the scheduler does not answer' not in (line := process.stderr.readline()):
        assert line
    assert address in line
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=100)
    assert (process.returncode, errors) == (0, "")
