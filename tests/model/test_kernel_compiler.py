# SPDX-License-Identifier: Apache-2.0
"""A process that compiles kernels gives the bytes of one that reads them from disk."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

# A kernel that calls others several times each, so that they are copied and not inlined.
_HEIGHTS = """
import hashlib
import numpy as np
from pugeo_model.geometry.quadric_at_points import heights_over_neighbours
points = np.random.default_rng(0).normal(size=(300, 3))
squared = ((points[:, None] - points) ** 2).sum(axis=2)
near = np.argsort(squared, axis=1)[:, 1:25].astype(np.int32)
values = np.concatenate(heights_over_neighbours(np.arange(300), points, near))
print(hashlib.sha256(values.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_the_first_process_gives_the_bytes_of_the_second(tmp_path: Path) -> None:
    """The first process finds an empty folder and compiles; the second one reads."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    told, stored = [], []
    for _ in range(2):
        command = [sys.executable, "-c", _HEIGHTS]
        done = subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True, timeout=300
        )
        told.append(done.stdout)
        stored.append({path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")})
    assert stored[0]
    assert stored[0] == stored[1], "the second process compiled too"
    assert told[0] == told[1]


def test_all_stored_kernels_are_compiled_by_it(root: Path) -> None:
    """A kernel of numba's own decorator would depend on what was loaded before it."""
    strangers, kernels = [], 0
    for path in (root / "model" / "pugeo_model").rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        stored = [
            each
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            for each in node.decorator_list
            if "cache=True" in ast.unparse(each)
        ]
        kernels += len(stored)
        origins = {
            node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and "njit" in {name.name for name in node.names}
        }
        named = {ast.unparse(each).partition("(")[0] for each in stored}
        if stored and (origins != {"pugeo_model.kernel_compiler"} or named != {"njit"}):
            strangers.append(path.name)
    assert kernels > 50
    assert strangers == []
