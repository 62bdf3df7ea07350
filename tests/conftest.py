# SPDX-License-Identifier: Apache-2.0
"""Fixtures of all tests, their order, and the number of random examples.

`make test` runs the files in two processes, in the order of `_ORDER`. Files with engines, and those
with services of their own, take longest, and come before all others.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings
from numpy.typing import NDArray

from pugeo_model.kernel_cache import compile_kernels

ROOT = Path(__file__).resolve().parents[1]
# Read when torch is loaded, here and in the processes that tests start. Threads of several
# processes wait for each other on busy cores: a small cloud then takes ten times the processor.
os.environ.setdefault("OMP_NUM_THREADS", "1")

_ORDER = (
    "tests/service/engine/test_engine.py",
    "tests/service/engine/test_dask_backend.py",
    "tests/e2e/test_service_lifecycle.py",
    "tests/e2e/test_jobs.py",
    "tests/deploy/test_chart_commands.py",
    "tests/client",
    "tests/e2e",
    "tests/docs/test_snippets.py",
    "tests/model/test_digests.py",
    "tests/benchmarks",
    "tests/service/engine",
    "tests/docs",
    "tests/model/reproduce",
    "tests/model/metrics",
)
"""Files and folders that come first; all others follow in the order of their names."""

# Examples are the same in every run, so that a failure is one of the change that is tested.
settings.register_profile("short", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("long", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "short"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the files by `_ORDER`."""

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(ROOT).as_posix()
        found = (n for n, start in enumerate(_ORDER) if f"{name}/".startswith(f"{start}/"))
        return next(found, len(_ORDER))

    items.sort(key=rank)


@pytest.fixture(scope="session")
def _kernels() -> None:
    """Compiled kernels, so that no time limit of a service includes their compilation."""
    folder = ROOT / ".cache"
    folder.mkdir(exist_ok=True)
    with FileLock(folder / "kernels.lock"):
        compile_kernels(print)


@pytest.fixture(scope="session")
def root() -> Path:
    """The folder of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def sphere() -> NDArray[np.float32]:
    """600 points spread evenly on the unit sphere: float32 ``(600, 3)``."""
    index = np.arange(600) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / 600), np.pi * (1 + 5**0.5) * index
    ring = np.sin(polar)
    points = np.stack([np.cos(azimuth) * ring, np.sin(azimuth) * ring, np.cos(polar)], axis=1)
    return points.astype(np.float32)
