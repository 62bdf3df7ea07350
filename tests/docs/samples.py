# SPDX-License-Identifier: Apache-2.0
"""Files that the pages take for granted: a LiDAR tile, a frame, scans, meshes with samples."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["FILES"]


def _ground(count: int) -> NDArray[np.float64]:
    """Gentle hills, 60 m wide, in UTM coordinates: ``(count, 3)``."""
    x, y = np.random.default_rng(0).random((2, count)) * 60
    height = 3 * np.sin(x / 11) * np.cos(y / 9)
    return np.stack([x, y, height], axis=1) + [441_000, 4_475_000, 120]


def tile(target: Path) -> None:
    """A LAS tile of ground, buildings and vegetation."""
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.array([441_000, 4_475_000, 0])
    las = laspy.LasData(header)
    las.xyz = _ground(3000)
    las.intensity = np.arange(3000, dtype=np.uint16)
    las.classification = np.repeat(np.array([2, 6, 5], np.uint8), 1000)
    las.write(str(target))


def frame(target: Path) -> None:
    """A frame in KITTI's layout."""
    points = (_ground(2000) - [441_030, 4_475_030, 121.7]).astype(np.float32)
    np.column_stack([points, np.ones(2000, np.float32)]).tofile(target)


def scans(target: Path) -> None:
    """A folder of two scans, and an empty one beside it for what becomes of them."""
    target.mkdir()
    (target.parent / "dense").mkdir()
    shutil.copy("examples/block.ply", target / "a.ply")
    shutil.copy("examples/knot.ply", target / "b.ply")


def _torus() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A closed mesh with a longest side of 1."""
    around, across = np.meshgrid(np.arange(48), np.arange(24), indexing="ij")
    u, v = 2 * np.pi * around.ravel() / 48, 2 * np.pi * across.ravel() / 24
    ring = 3 + np.cos(v)
    vertices = np.stack([np.cos(u) * ring, np.sin(u) * ring, np.sin(v)], axis=1) / 8

    def row(i: int, j: int) -> NDArray[np.int64]:
        rows: NDArray[np.int64] = ((around + i) % 48 * 24 + (across + j) % 24).ravel()
        return rows

    first = np.stack([row(0, 0), row(1, 0), row(1, 1)], axis=1)
    second = np.stack([row(0, 0), row(1, 1), row(0, 1)], axis=1)
    return vertices, np.concatenate([first, second])


def meshes(target: Path) -> None:
    """A folder of meshes to train on, and one to validate with."""
    import igl

    vertices, faces = _torus()
    for name in ("train/torus.ply", "train/flat.ply", "val/torus.ply"):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        stretch = [1, 1, 0.6] if "flat" in name else [1, 1, 1]
        igl.write_triangle_mesh(str(target / name), vertices * stretch, faces)


def samples(target: Path) -> None:
    """Sparse inputs and dense samples of the validation mesh."""
    from pugeo_model.cloud import Cloud
    from pugeo_model.formats import write
    from pugeo_model.mesh.sampling import poisson_disk

    vertices, faces = _torus()
    rng = np.random.default_rng(0)

    def sample(name: str, count: int, noise: float = 0.0) -> None:
        points = poisson_disk(vertices, faces, count, rng)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        noisy = points + rng.normal(0, noise, points.shape)
        write(Cloud(noisy.astype(np.float32)), target / name)

    sample("inputs/torus_5000.ply", 5000)
    for kind, noise in (("", 0.0), ("_noise01", 0.005), ("_noise02", 0.01), ("_random", 0.0)):
        sample(f"inputs/torus_2048{kind}.ply", 2048, noise)
    for count in (8192, 20_000, 80_000):
        sample(f"gt/torus_{count}.ply", count)


def weights(target: Path) -> None:
    """Weights with their card, as of a training."""
    from pugeo_model.weights import locate

    for suffix in (".safetensors", ".json"):
        shutil.copy(locate("fast").with_suffix(suffix), target.with_suffix(suffix))


FILES: dict[str, Callable[[Path], None]] = {
    "tile.las": tile,
    "frame.bin": frame,
    "scans": scans,
    "meshes": meshes,
    "samples": samples,
    "mine.safetensors": weights,
}
"""Name on a page -> function that makes the file or folder of that name."""
