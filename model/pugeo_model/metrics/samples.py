# SPDX-License-Identifier: Apache-2.0
"""Samples of meshes for :mod:`pugeo_model.metrics.evaluation`: sparse inputs and dense references.

The folder gets ``meshes/NAME.ply`` (centred, longest side 1), ``inputs/NAME_kind.ply`` and
``gt/NAME_count.ply``. All are drawn from the name of the shape and the seed, so that another run
gives the same files.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats import write
from pugeo_model.mesh.files import mesh_files, read_mesh, unit_size, write_mesh
from pugeo_model.mesh.sampling import poisson_disk, uniform
from pugeo_model.metrics.evaluation import CASES

__all__ = ["write_samples"]

_NOISE = {"noise01": 0.01, "noise02": 0.02}
"""Standard deviation of the noise, in radii of the sphere around the centre of the box."""


def write_samples(meshes: Path, out: Path, seed: int = 0) -> Iterator[tuple[str, int, int]]:
    """Sample all meshes of a folder as the cases of the evaluation need it.

    Args:
        meshes: folder of triangle meshes of any size.
        out: folder of the samples; made if it is missing.
        seed: another one gives other samples.

    Yields:
        After each mesh its name, the number of those that are done, and of all.

    Raises:
        FileNotFoundError: the folder has no mesh.
        ValueError: a mesh has no face, or no area.
    """
    files = mesh_files(meshes)
    for folder in ("meshes", "inputs", "gt"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(files):
        vertices, faces = read_mesh(path)
        if not len(faces) or not np.ptp(vertices, axis=0).max() > 0:
            raise ValueError(f"{path} has no triangles")
        vertices = unit_size(vertices)
        write_mesh(vertices, faces, out / "meshes" / f"{path.stem}.ply")
        _sample(path.stem, vertices, faces, out, seed)
        yield path.stem, number + 1, len(files)


def _sample(
    name: str, vertices: NDArray[np.float64], faces: NDArray[np.int64], out: Path, seed: int
) -> None:
    """Write all samples of one shape."""
    radius = float(np.linalg.norm(vertices, axis=1).max())
    even: dict[int, NDArray[np.float64]] = {}

    def draw(count: int, purpose: str) -> NDArray[np.float64]:
        return poisson_disk(vertices, faces, count, _rng(name, purpose, seed))

    for kind in dict.fromkeys(case.kind for case in CASES):
        size, _, change = kind.partition("_")
        count = int(size)
        if change == "random":
            points = uniform(vertices, faces, count, _rng(name, kind, seed))
        else:
            if count not in even:
                even[count] = draw(count, size)
            points = even[count]
            if change:
                noise = _rng(name, kind, seed).normal(size=points.shape)
                points = points + _NOISE[change] * radius * noise
        _write(points, out / "inputs" / f"{name}_{kind}.ply")
    for count in dict.fromkeys(case.reference for case in CASES):
        _write(draw(count, f"gt {count}"), out / "gt" / f"{name}_{count}.ply")


def _rng(name: str, purpose: str, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(f"{name} {purpose}".encode())])


def _write(points: NDArray[np.float64], path: Path) -> None:
    write(Cloud(points.astype(np.float32)), path)
