# SPDX-License-Identifier: Apache-2.0
"""Training shapes: meshes with Poisson-disk samples, cached on disk by content hash."""

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
from numpy.typing import NDArray

from pugeo_model.mesh.files import read_mesh, unit_size
from pugeo_model.mesh.sampling import face_normals, poisson_disk, uniform

__all__ = ["SIZES", "Shape", "content_hash", "default_cache", "load_shape"]

SIZES = (1024, 2048, 3500, 5000, 8000)
"""Sizes of the Poisson-disk inputs of each shape, from unresolved to resolved features."""

_POOL = 60_000  # uniform samples per shape: ground truth for coverage, source of random inputs
_VERSION = 1  # of the cached samples; to be increased when the sampling changes


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh, longest side 1, and samples of it.

    Attributes:
        name: name of the file without its suffix.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        normals: ``(F, 3)`` float64 unit face normals.
        pool: ``(60000, 3)`` float32 independent uniform samples.
        inputs: Poisson-disk samples, one ``(M, 3)`` float64 array for each of `SIZES`.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    pool: NDArray[np.float32]
    inputs: tuple[NDArray[np.float64], ...]


def content_hash(files: Iterable[Path]) -> str:
    """Compute a SHA-256 over the names and contents of files, for the model card."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def default_cache() -> Path:
    """Return the folder of cached samples: ``$PUGEO_CACHE`` or one in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PUGEO_CACHE") or Path(base) / "pugeo")


def load_shape(path: Path, cache: Path) -> Shape:
    """Load a mesh and its samples; samples are cached by the content of the file.

    Args:
        path: the mesh.
        cache: folder of cached samples, created if needed.
    """
    key = hashlib.sha256(path.read_bytes() + f"{_VERSION} {SIZES} {_POOL}".encode()).hexdigest()
    stored = cache / f"{key[:32]}.npz"
    vertices, faces = read_mesh(path)
    if not stored.exists():
        vertices = unit_size(vertices)
        rng = np.random.default_rng(int(key[:16], 16))
        arrays = {f"input_{size}": poisson_disk(vertices, faces, size, rng) for size in SIZES}
        arrays["pool"] = uniform(vertices, faces, _POOL, rng)
        arrays["vertices"] = vertices
        cache.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=cache, suffix=".npz", delete=False) as file:
            np.savez(
                file, allow_pickle=False, **{k: v.astype(np.float32) for k, v in arrays.items()}
            )
        Path(file.name).replace(stored)
    with np.load(stored) as kept:
        vertices = kept["vertices"].astype(np.float64)
        return Shape(
            name=path.stem,
            vertices=vertices,
            faces=faces,
            normals=face_normals(vertices, faces),
            pool=kept["pool"],
            inputs=tuple(kept[f"input_{size}"].astype(np.float64) for size in SIZES),
        )
