# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels find a folder, wherever the package is installed."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pugeo_model import kernel_cache


@pytest.fixture
def read_only(tmp_path: Path, root: Path) -> Path:
    """A copy of the package in a folder that cannot be written."""
    shutil.copytree(
        root / "model" / "pugeo_model",
        tmp_path / "site" / "pugeo_model",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    return tmp_path / "site"


@pytest.mark.slow
def test_a_read_only_installation_without_a_home(
    read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the package nor a home can be written: kernels go into the temporary folder."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    code = (
        "import os, sys; access = os.access; "
        f"os.access = lambda path, mode: str(path).startswith({str(tmp_path / 'tmp')!r}) "
        "and access(path, mode); "
        f"sys.path.insert(0, {str(read_only)!r}); "
        "import pugeo_model; print(os.environ['NUMBA_CACHE_DIR'], pugeo_model.__file__)"
    )
    (tmp_path / "tmp").mkdir()
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": "/nonexistent",
        "TMPDIR": str(tmp_path / "tmp"),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True
    )
    folder, module = done.stdout.split()
    assert folder.startswith(str(tmp_path / "tmp"))
    assert module.startswith(str(read_only))
    assert Path(folder).stat().st_mode & 0o077 == 0


def test_a_chosen_folder_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NUMBA_CACHE_DIR stays as it is where it can be written."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache.use_writable_folder()
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path)


def test_markers_of_other_sources_are_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The marker of an upgrade replaces that of the version before; others' markers stay."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache._mark_compiled()
    mine = kernel_cache._marker().name
    monkeypatch.setattr(kernel_cache, "_processor", lambda: "another")
    kernel_cache._mark_compiled()
    neighbour = kernel_cache._marker().name
    monkeypatch.setattr(kernel_cache, "stamp", lambda *_: "0" * 64)
    assert not kernel_cache.compiled()
    (tmp_path / "compiled-elsewhere").touch()
    assert {path.name for path in tmp_path.iterdir()} == {mine, neighbour, "compiled-elsewhere"}
    kernel_cache._mark_compiled()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {kernel_cache._marker().name, "compiled-elsewhere"}


def test_kernels_are_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second call finds the marker of the first one and compiles nothing."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    code = "from pugeo_model import kernel_cache; kernel_cache._marker().touch()"
    monkeypatch.setattr(kernel_cache, "_COMPILE", code)
    said: list[str] = []
    kernel_cache.compile_kernels(said.append)
    kernel_cache.compile_kernels(said.append)
    assert [sentence.split()[0] for sentence in said] == ["compiling", "compiled"]


def test_a_compilation_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of its output is in the error."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "_COMPILE", "raise SystemExit('no compiler')")
    with pytest.raises(RuntimeError, match="no compiler"):
        kernel_cache.compile_kernels(lambda _: None)


@pytest.mark.long
def test_all_kernels_of_an_upsampling_are_compiled(root: Path, tmp_path: Path) -> None:
    """No kernel is left to be compiled silently by the first large or noisy scan."""
    package = root / "model" / "pugeo_model"
    defined = {
        f"{path.stem}.{node.name}"
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.FunctionDef)
        and any("njit" in ast.unparse(each) for each in node.decorator_list)
    }
    code = "from pugeo_model.kernel_cache import _compile_here; _compile_here()"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    stored = {path.name.rsplit("-", 1)[0] for path in tmp_path.rglob("*.nbi")}
    # These are of training, of networks that upsample whole patches, and of CPUs with bfloat16.
    elsewhere = {"pooling", "farthest", "bfloat16"}
    assert {name for name in defined - stored if name.split(".")[0] not in elsewhere} == set()
