# SPDX-License-Identifier: Apache-2.0
"""Pairs of sparse and dense Poisson-disk samples with normals, the paper's training data."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
from numpy.typing import NDArray

from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.mesh.sampling import poisson_disk
from pugeo_model.training.corpus import SIZES, Shape

__all__ = ["SPARSE", "Pair", "load_pair", "load_pairs"]

SPARSE = 5000
"""Points M of the sparse input of every shape (section 4.1)."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A sparse and a dense sample of one shape, longest side 1.

    Attributes:
        sparse: ``(M, 6)`` float32 points and unit face normals.
        dense: ``(R M, 6)`` float32 points and unit face normals.
    """

    sparse: NDArray[np.float32]
    dense: NDArray[np.float32]


def load_pairs(
    shapes: Sequence[Shape],
    ratio: int,
    cache: Path,
    tick: Callable[[int, int], None] | None = None,
) -> list[Pair]:
    """Pairs of all shapes, made once and cached; ``tick`` is told how many are done."""
    pairs = []
    for done, shape in enumerate(shapes):
        if tick:
            tick(done, len(shapes))
        pairs.append(load_pair(shape, ratio, cache))
    return pairs


def load_pair(shape: Shape, ratio: int, cache: Path) -> Pair:
    """The pair of a shape, from the cache where its samples are known there."""
    sparse = shape.inputs[SIZES.index(SPARSE)]
    digest = hashlib.sha256(sparse.tobytes() + shape.faces.tobytes() + f"{ratio}".encode())
    key = digest.hexdigest()
    stored = cache / f"pair_{key[:32]}.npz"
    if not stored.exists():
        rng = np.random.default_rng(int(key[:16], 16))
        dense = poisson_disk(shape.vertices, shape.faces, ratio * SPARSE, rng)
        distance = MeshDistance(shape.vertices, shape.faces)
        made = {
            name: np.concatenate([points, shape.normals[distance.nearest(points)[1]]], axis=1)
            for name, points in (("sparse", sparse), ("dense", dense))
        }
        cache.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=cache, suffix=".npz", delete=False) as file:
            np.savez(file, allow_pickle=False, **{k: v.astype(np.float32) for k, v in made.items()})
        Path(file.name).replace(stored)
    with np.load(stored) as kept:
        return Pair(kept["sparse"], kept["dense"])
