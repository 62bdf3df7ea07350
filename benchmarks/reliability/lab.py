# SPDX-License-Identifier: Apache-2.0
"""Several machines on one: network namespaces that a bridge joins, each with processes of its own.

Each host has its own network and its own numbers of processes, so that no process reaches another
one but through the network. All share the disk. Needs Linux, root and iproute2.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from benchmarks.reliability.processes import psutil

__all__ = ["Host", "lab", "missing"]

_NETWORK = "10.213.47"
_PREFIX = "pugeo-"
_BRIDGE = "pugeo-bridge"
_PUGEO = "from pugeo_model.cli import main; main()"
_END_S = 90.0


def missing() -> str | None:
    """Return what this machine lacks for a lab, or ``None``."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "network namespaces need Linux and root"
    programs = [name for name in ("ip", "unshare") if shutil.which(name) is None]
    if programs:
        return f"there is no {' and no '.join(programs)} (packages iproute2, util-linux)"
    tried = subprocess.run(["unshare", "--net", "true"], check=False, capture_output=True)
    return None if tried.returncode == 0 else "this system allows no network namespaces"


class Host:
    """A machine of the lab, on which one `pugeo` command runs at a time.

    Args:
        name: of the machine.
        number: its place in the network, from 2.
        log: file for what its commands print.
    """

    def __init__(self, name: str, number: int, log: Path) -> None:
        self.name = name
        self.address = f"{_NETWORK}.{number}"
        self.log = log
        self._space = f"{_PREFIX}{name}"
        self._link = f"pg-{number}"
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def runs(self) -> bool:
        """True while a command runs on it."""
        return self._process is not None and self._process.poll() is None

    def connect(self) -> None:
        """Make the namespace and its link to the bridge."""
        _ip("netns", "add", self._space)
        far = f"{self._link}-in"
        _ip("link", "add", self._link, "type", "veth", "peer", "name", far)
        _ip("link", "set", far, "netns", self._space, "name", "eth0")
        _ip("link", "set", self._link, "master", _BRIDGE, "up")
        _ip("-n", self._space, "address", "add", f"{self.address}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            _ip("-n", self._space, "link", "set", device, "up")

    def disconnect(self) -> None:
        """Remove the namespace with its link."""
        for command in (("link", "delete", self._link), ("netns", "delete", self._space)):
            with suppress(subprocess.CalledProcessError):
                _ip(*command)

    def cut(self) -> None:
        """Take the link down: no packet comes or goes, and no connection is closed."""
        _ip("link", "set", self._link, "down")

    def mend(self) -> None:
        """Bring the link up again."""
        _ip("link", "set", self._link, "up")

    def start(self, *arguments: str, **environment: str) -> None:
        """Run ``pugeo`` with these arguments."""
        inside = ["ip", "netns", "exec", self._space]
        alone = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child=SIGKILL"]
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [*inside, *alone, sys.executable, "-c", _PUGEO, *arguments],
                stdout=log,
                stderr=log,
                env={**os.environ, "PUGEO_LOG_FORMAT": "json", **environment},
                process_group=0,
            )

    def kill(self) -> None:
        """End all processes of the host at once, without a word to anyone."""
        if self._process is not None:
            # The first process of a namespace takes all others with it.
            for child in psutil.Process(self._process.pid).children():
                child.kill()
            self._process.wait(_END_S)
            self._process = None

    def stop(self) -> int | None:
        """Send SIGTERM; return the exit status, ``None`` if nothing runs or it does not end."""
        process, self._process = self._process, None
        if process is None:
            return None
        for child in psutil.Process(process.pid).children():
            child.send_signal(signal.SIGTERM)
        try:
            return process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return None


@contextmanager
def lab(folder: Path, names: list[str]) -> Iterator[dict[str, Host]]:
    """Join hosts by a bridge, at which this process is too; remove all at the end.

    Args:
        folder: for the logs.
        names: of the hosts.
    """
    hosts = {
        name: Host(name, number, folder / f"{name}.log")
        for number, name in enumerate(names, start=2)
    }
    _remove(hosts)  # left by an earlier run
    try:
        _ip("link", "add", _BRIDGE, "type", "bridge")
        _ip("address", "add", f"{_NETWORK}.1/24", "dev", _BRIDGE)
        _ip("link", "set", _BRIDGE, "up")
        for host in hosts.values():
            host.connect()
        yield hosts
    finally:
        for host in hosts.values():
            with suppress(Exception):
                host.kill()
        _remove(hosts)


def _remove(hosts: dict[str, Host]) -> None:
    for host in hosts.values():
        host.disconnect()
    with suppress(subprocess.CalledProcessError):
        _ip("link", "delete", _BRIDGE)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
