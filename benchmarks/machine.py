# SPDX-License-Identifier: Apache-2.0
"""The machine that the figures were measured on."""

import os
import platform
import resource
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from pugeo_model.weights import read_card

__all__ = ["describe", "peak_bytes"]

_ROOT = Path(__file__).parent.parent
_LIBRARIES = ("torch", "numpy", "scipy", "numba")


def describe(core: int | None, model: str = "standard") -> list[tuple[str, str]]:
    """Label and value of everything that a figure depends on.

    Args:
        core: the core that work is pinned to, or ``None``.
        model: name or path of the weights.

    Raises:
        BadOptionError: no such weights.
    """
    card = read_card(model)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return [
        ("processor", _processor()),
        ("cores", f"{os.cpu_count()}, of which one used: {'any' if core is None else core}"),
        ("memory", f"{_memory_bytes() / 2**30:.0f} GiB"),
        ("load before the run (1, 5, 15 min)", load),
        ("system", f"{platform.system()} {platform.release()}, Python {platform.python_version()}"),
        ("libraries", ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)),
        ("pugeo", f"{version('pugeo')}, commit {_commit()}"),
        ("weights", f"{card['name']} {card['version']}, sha256 {card['sha256'][:12]}"),
    ]


def peak_bytes() -> int:
    """The most memory that this process ever held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _memory_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _commit() -> str:
    """Short hash, with ``-dirty`` where files differ from it; ``unknown`` outside a repository."""
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
