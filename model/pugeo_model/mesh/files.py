# SPDX-License-Identifier: Apache-2.0
"""Files of triangle meshes."""

import shutil
import tempfile
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

from pugeo_model.formats.stream import replacing

__all__ = ["mesh_files", "read_mesh", "unit_size", "write_mesh"]

_KINDS = frozenset({".ply", ".obj", ".off", ".stl"})


def mesh_files(folder: Path) -> list[Path]:
    """Return the meshes of a folder, sorted by name.

    Raises:
        FileNotFoundError: the folder has no mesh.
    """
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in _KINDS)
    if not found:
        raise FileNotFoundError(f"no mesh ({', '.join(sorted(_KINDS))}) in {folder}")
    return found


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read vertices ``(V, 3)`` float64 and faces ``(F, 3)`` int64."""
    vertices, faces = igl.read_triangle_mesh(str(path))
    return vertices.astype(np.float64), faces.astype(np.int64)


def unit_size(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centre vertices ``(V, 3)`` on their bounding box and scale its longest side to 1."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scaled: NDArray[np.float64] = (vertices - (low + high) / 2) / (high - low).max()
    return scaled


def write_mesh(vertices: NDArray[np.float64], faces: NDArray[np.int64], path: Path) -> None:
    """Write a mesh as binary PLY with double coordinates; an older file is replaced at the end.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as file, tempfile.TemporaryDirectory() as folder:
        # The library tells the format by the suffix, and reports no error.
        made = Path(folder) / "mesh.ply"
        made.touch()
        igl.write_triangle_mesh(str(made), vertices, faces, igl.FileEncoding.Binary)
        if made.stat().st_size == 0:
            raise OSError(f"{path} cannot be written")
        with made.open("rb") as mesh:
            shutil.copyfileobj(mesh, file)
