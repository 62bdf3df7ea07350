# SPDX-License-Identifier: Apache-2.0
"""Faults of the machine and of settings are told in one line before anything starts."""

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pugeo_service import preflight
from pugeo_service.server import main
from pugeo_service.settings import Settings


def test_a_machine_without_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without /dev/shm no worker process can start; it is told how to get one."""
    assert preflight.unfit_machine(Settings()) is None

    def refuse(_: object) -> None:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(multiprocessing.get_context("spawn").__class__, "Lock", refuse)
    line = preflight.unfit_machine(Settings())
    assert line is not None
    assert "writable /dev/shm" in line
    assert preflight.unfit_machine(Settings(engine="inline")) is None


def test_a_machine_without_proc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without /proc workers cannot be watched."""
    monkeypatch.setattr(preflight, "_PROC", tmp_path / "missing")
    monkeypatch.setattr(sys, "platform", "linux")
    assert (preflight.unfit_machine(Settings()) or "").startswith("/proc is not mounted")


def test_a_wrong_setting_ends_with_one_line(tmp_path: Path) -> None:
    """The process ends with status 2 and one line on stderr, before anything starts."""
    environment = {**os.environ, "PUGEO_WORKER_MEMORY": "abc", "PUGEO_SPOOL_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pugeo_service"]
    done = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[1:] == []
    assert done.stderr.startswith("PUGEO_WORKER_MEMORY=abc: must be auto")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("host", ["no-such-host.invalid", "192.0.2.1"])
def test_a_host_of_another_machine(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, host: str
) -> None:
    """An address that is not of this machine, or a name of nothing, ends with one line."""
    monkeypatch.setenv("PUGEO_SPOOL_DIR", str(tmp_path))
    assert main({"host": host}) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith(f"PUGEO_HOST={host}: must be an address or name of this machine (")
    assert printed.out == ""
    assert list(tmp_path.iterdir()) == []


def test_hosts_of_this_machine() -> None:
    """Names and addresses of it are taken, and those that stand for all."""
    for host in ("localhost", "127.0.0.1", "0.0.0.0"):  # noqa: S104 - nothing listens
        assert preflight.unusable_host(host, "PUGEO_HOST") is None


def test_a_scheduler_without_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """Port 0 is for the scheduler itself; nobody can reach it."""
    settings = Settings()
    monkeypatch.setitem(settings.__dict__, "scheduler", "tls://scheduler:0")
    assert (preflight.unfit_machine(settings) or "").startswith("PUGEO_SCHEDULER=tls://scheduler:0")


HIDE = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hide())
sys.argv = ["pugeo", *{arguments!r}]
from pugeo_model.cli import main
main()
"""


@pytest.mark.parametrize(
    ("arguments", "hidden", "extra"),
    [
        (["serve"], ["fastapi", "uvicorn", "structlog", "distributed"], "server"),
        (["keys", "new", "ann"], ["structlog"], "server"),
        (["train", "folder", "-o", "out"], ["igl", "matplotlib"], "train"),
    ],
)
def test_commands_without_their_extra(arguments: list[str], hidden: list[str], extra: str) -> None:
    """A command whose packages are missing says which extra to install, without a traceback."""
    code = HIDE.format(hidden=set(hidden), arguments=arguments)
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"pip install 'pugeo[{extra}]" in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr
