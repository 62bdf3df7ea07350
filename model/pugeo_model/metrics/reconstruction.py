# SPDX-License-Identifier: Apache-2.0
"""Surfaces from points and normals: screened Poisson reconstruction (Kazhdan and Hoppe 2013).

The authors' own code does the work, as COLMAP ships it. It takes and gives files, and leaves one
parameter at its default that the protocol sets to 1: 1.5 samples a node. MeshLab's build of an
older version of the code, which has the parameter, shows that this is without effect: with 1 and
with 1.5 the columns of the limit differ by less than they do between the two builds.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import igl
import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats import write

__all__ = ["DEPTH", "Mesh", "library", "reconstruct"]

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices ``(V, 3)`` and faces ``(F, 3)``."""

DEPTH = 9
"""Depth of the octree: the finest cells are a 2^9th of 1.1 times the longest side."""

_POINT_WEIGHT = 4.0  # of the screening: how much points pull the surface; the paper's value


def library() -> ModuleType:
    """The library that reconstructs.

    Raises:
        ModuleNotFoundError: it is not installed; the message says what to do.
    """
    try:
        import pycolmap
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "reconstructing surfaces needs pycolmap: pip install 'pugeo[evaluate]'",
            name="pycolmap",
        ) from missing
    return pycolmap


def reconstruct(
    points: NDArray[np.floating], normals: NDArray[np.floating], depth: int = DEPTH
) -> Mesh:
    """The surface through oriented points.

    Args:
        points: ``(K, 3)``.
        normals: ``(K, 3)`` unit, outward; where they point inward the surface folds.
        depth: of the octree.

    Raises:
        ModuleNotFoundError: pycolmap is not installed.
        RuntimeError: no surface came out, as from points that span none.
    """
    pycolmap = library()
    options = pycolmap.PoissonMeshingOptions(
        depth=depth,
        point_weight=_POINT_WEIGHT,
        trim=0.0,
        color=False,
        num_threads=1,  # more give another mesh every time
    )
    with TemporaryDirectory() as folder:
        source, target = Path(folder) / "points.ply", Path(folder) / "surface.ply"
        write(
            Cloud(points.astype(np.float32), normals=normals.astype(np.float32)),
            source,
            format="ply",
        )
        pycolmap.poisson_meshing(source, target, options)
        if not target.exists():
            raise RuntimeError("screened Poisson reconstruction gave no surface")
        vertices, faces = igl.read_triangle_mesh(str(target))
    if not len(faces):
        raise RuntimeError("screened Poisson reconstruction gave an empty surface")
    return vertices.astype(np.float64), faces.astype(np.int64)
