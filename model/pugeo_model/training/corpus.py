# SPDX-License-Identifier: Apache-2.0
"""The training shapes: meshes with Poisson-disk inputs, cached on disk by content hash."""

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.resample.elimination import eliminate, packing_radius

__all__ = [
    "SIZES",
    "Shape",
    "content_hash",
    "default_cache",
    "face_normals",
    "load_shape",
    "mesh_files",
    "poisson_disk",
]

SIZES = (1024, 2048, 3500, 5000, 8000)
"""Points of the Poisson-disk inputs of every shape: from features lost to features resolved."""

_POOL = 60_000  # uniform samples a shape: ground truth for coverage, source of random inputs
_OVERSAMPLE = 5  # candidates a kept sample, as Yuksel advises
_VERSION = 1  # of the sampling below; raise it when the cache must be made anew


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh, longest side 1, and samples of it.

    Attributes:
        name: the file's stem.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        normals: ``(F, 3)`` float64 unit face normals.
        pool: ``(60000, 3)`` float32 independent uniform samples.
        inputs: Poisson-disk samples, one ``(M, 3)`` float64 array for each of ``SIZES``.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    pool: NDArray[np.float32]
    inputs: tuple[NDArray[np.float64], ...]


def mesh_files(folder: Path) -> list[Path]:
    """Meshes of a folder, sorted by name.

    Raises:
        FileNotFoundError: the folder has no mesh.
    """
    kinds = {".ply", ".obj", ".off", ".stl"}
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in kinds)
    if not found:
        raise FileNotFoundError(f"no mesh ({', '.join(sorted(kinds))}) in {folder}")
    return found


def content_hash(files: Iterable[Path]) -> str:
    """SHA-256 over the names and bytes of all files, for the model card."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def default_cache() -> Path:
    """Where samples are kept between runs: ``$PUGEO_CACHE`` or the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PUGEO_CACHE") or Path(base) / "pugeo")


def load_shape(path: Path, cache: Path) -> Shape:
    """A mesh with its samples, from the cache where its content is known there."""
    key = hashlib.sha256(path.read_bytes() + f"{_VERSION} {SIZES} {_POOL}".encode()).hexdigest()
    stored = cache / f"{key[:32]}.npz"
    vertices, faces = igl.read_triangle_mesh(str(path))
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    if not stored.exists():
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        vertices = (vertices - (low + high) / 2) / (high - low).max()
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


def face_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals ``(F, 3)``; zero for a face without area."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit: NDArray[np.float64] = normal / np.maximum(length, 1e-300)
    return unit


def uniform(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Independent samples, uniform by area, ``(count, 3)``."""
    corner = vertices[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    mixed: NDArray[np.float64] = np.einsum("nc,ncd->nd", weights, corner[chosen])
    return mixed


def poisson_disk(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """An even sample of exactly ``count`` points by sample elimination, ``(count, 3)``."""
    corner = vertices[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    share = 0.5 * np.linalg.norm(cross, axis=1).sum() / count
    candidates = uniform(vertices, faces, _OVERSAMPLE * count, rng)
    reach = np.full(len(candidates), packing_radius(np.array(share)))
    distance, rows = knn(cKDTree(candidates), candidates, 28, reach[0])
    others = np.where(np.isfinite(distance), rows, -1)[:, 1:].astype(
        np.int32
    )  # the first is itself
    return candidates[eliminate(candidates, others, reach, count)]
