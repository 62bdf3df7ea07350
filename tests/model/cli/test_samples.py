# SPDX-License-Identifier: Apache-2.0
"""``pugeo samples`` and ``pugeo upsample --mesh``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_model.mesh.files import read_mesh

Run = Callable[..., Any]


def test_refused(pugeo: Run, tmp_path: Path) -> None:
    """A folder that is none, has no mesh, or is a file is named in one line."""
    (tmp_path / "file").touch()
    for arguments, words in (
        ((tmp_path / "none", "-o", tmp_path / "out"), "is no folder"),
        ((tmp_path, "-o", tmp_path / "out"), "no mesh"),
        ((tmp_path, "-o", tmp_path / "file"), "is a file"),
    ):
        done = pugeo("samples", *arguments)
        assert done.status == 2
        assert words in done.stderr


def test_a_mesh_of_the_result(pugeo: Run, scan: Run, tmp_path: Path) -> None:
    """--mesh writes a mesh of the dense cloud, in its frame; its size is told."""
    pytest.importorskip("pycolmap")
    mesh = tmp_path / "mesh.ply"
    done = pugeo("upsample", scan("a.ply", 1000), "-o", tmp_path / "x.ply", "--mesh", mesh)
    assert done.status == 0, done.stderr
    vertices, faces = read_mesh(mesh)
    assert f"mesh of {len(faces):,} faces in {mesh}" in done.stderr
    assert np.abs(np.linalg.norm(vertices, axis=1) - 10).max() < 1
    again = pugeo("upsample", tmp_path / "a.ply", "-o", tmp_path / "y.ply", "--mesh", mesh)
    assert again.status == 2
    assert "--overwrite" in again.stderr
