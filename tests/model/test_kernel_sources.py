# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled anew when anything changed that they are made of."""

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from pugeo_model import kernel_compiler, kernel_sources

# `tilt` calls `cross`, which is in another module.
_TILT = """
import numpy as np
from pugeo_model.geometry.quadric import tilt
frame = np.eye(3)
tilt(frame, np.zeros(6))
print(frame[1, 1])
"""


@pytest.fixture
def package(root: Path, tmp_path: Path) -> Path:
    """A copy of the package, which can be changed."""
    copy = tmp_path / "site" / "pugeo_model"
    ignored = shutil.ignore_patterns("__pycache__", "released")
    shutil.copytree(root / "model" / "pugeo_model", copy, ignore=ignored)
    return copy


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    """Read files and versions anew, before and after a test that changes them."""
    cached = (kernel_sources.stamp, kernel_sources._read, kernel_sources._compilers)
    for each in cached:
        each.cache_clear()
    yield
    for each in cached:
        each.cache_clear()


def _imported(module: Path, home: Path) -> set[Path]:
    """A module, and all that it imports at its top from its package, directly or not."""
    found: set[Path] = set()
    left = [module]
    while left:
        path = left.pop()
        if path in found:
            continue
        found.add(path)
        for node in ast.parse(path.read_text("utf-8")).body:
            names = [each.name for each in getattr(node, "names", ())]
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module), *(f"{node.module}.{name}" for name in names)]
            for name in names:
                if name.startswith("pugeo_model."):
                    place = home.joinpath(*name.split("."))
                    files = (place.with_suffix(".py"), place / "__init__.py")
                    left += [file for file in files if file.exists()]
    return found


def test_all_that_kernels_are_made_of_is_a_source(root: Path) -> None:
    """No kernel has a constant of a module that its stamp leaves out."""
    modules = kernel_sources.modules_with_kernels()
    assert len(modules) > 20
    for module in modules:
        assert kernel_sources.sources(module) == _imported(module, root / "model")


def test_all_modules_with_kernels_are_found(root: Path) -> None:
    """However its decorator is written, a stored kernel counts."""
    package = root / "model" / "pugeo_model"
    written = {path for path in package.rglob("*.py") if "cache=True" in path.read_text("utf-8")}
    written.discard(package / "kernel_sources.py")
    assert set(kernel_sources.modules_with_kernels()) == written


@pytest.mark.parametrize(
    ("changed", "counts"),
    [
        ("geometry/quadric.py", True),
        ("geometry/pca.py", True),  # imported
        ("tuning_scale.py", True),  # imported by what is imported
        ("kernel_compiler.py", True),
        ("geometry/knn.py", False),
        ("plan.py", False),
    ],
)
def test_a_change_of_a_source_changes_the_stamp(package: Path, changed: str, counts: bool) -> None:
    """Contents count, and not times; what the module does not import does not count."""
    module, path = package / "geometry" / "quadric.py", package / changed
    first = kernel_sources.stamp(module, package=package)
    for content, differs in ((path.read_bytes() + b"\n", counts), (path.read_bytes(), False)):
        path.write_bytes(content)
        kernel_sources.stamp.cache_clear()
        kernel_sources._read.cache_clear()
        assert (kernel_sources.stamp(module, package=package) != first) is differs


@pytest.mark.parametrize("changed", ["llvmlite", "numba", "numpy"])
def test_another_compiler_changes_the_stamp(changed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An upgrade of any of them compiles anew."""
    first = kernel_sources.stamp()
    kernel_sources.stamp.cache_clear()
    kernel_sources._compilers.cache_clear()
    monkeypatch.setattr(
        "pugeo_model.kernel_sources.version",
        lambda name: "0" if name == changed else version(name),
    )
    assert kernel_sources.stamp() != first


def test_a_kernel_at_another_line_replaces_the_stored_one(tmp_path: Path) -> None:
    """Each upgrade would else leave kernels behind wherever a number of a line changed."""
    kept = {
        "frames._rough-12.py311.nbi",
        "frames._rough-12.py311.1.nbc",
        "frames._rough-7.py312.nbi",  # of another Python
        "frames._rough_too-7.py311.nbi",
        "frames.cpython-311.pyc",
    }
    outdated = {"frames._rough-7.py311.nbi", "frames._rough-7.py311.2.nbc"}
    for name in kept | outdated:
        (tmp_path / name).touch()
    kernel_compiler._drop_other_lines(tmp_path, "frames._rough-12.py311")
    assert {path.name for path in tmp_path.iterdir()} == kept


@pytest.mark.slow
def test_a_change_of_a_called_function_reaches_its_caller(package: Path) -> None:
    """The stored kernel of the caller is outdated, though its own module did not change."""
    unset = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment = {**unset, "PYTHONPATH": str(package.parent)}

    def tilted() -> float:
        command = [sys.executable, "-c", _TILT]
        done = subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True, timeout=100
        )
        return float(done.stdout)

    def stored() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in package.rglob("quadric.tilt-*.nb[ic]")}

    assert tilted() == 1.0
    first = stored()
    assert tilted() == 1.0
    assert len(first) == 2
    assert stored() == first
    pca, quadric = package / "geometry" / "pca.py", package / "geometry" / "quadric.py"
    source = pca.read_text("utf-8")
    changed = source.replace("= x, y, z\n", "= -x, -y, -z\n")
    assert changed != source
    pca.write_text(changed, "utf-8")
    assert tilted() == -1.0
    assert set(stored()) == set(first)
    quadric.write_text(quadric.read_text("utf-8").replace("\n@njit", "\n\n@njit"), "utf-8")
    assert tilted() == -1.0
    assert len(stored()) == 2
    assert not set(stored()) & set(first)
