# SPDX-License-Identifier: Apache-2.0
"""Checksums of the answers to a fixed set of clouds, options and models.

A change that is meant to leave results alone leaves these alone. Floating point results differ
between processors and between versions of torch, numpy and numba, so checksums are recorded for
each such platform: ``make digests`` records this one's.
"""

import argparse
import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.upsampler import Upsampler

__all__ = ["CASES", "FILE", "digest", "platform"]

FILE = Path(__file__).resolve().parents[1] / "tests" / "model" / "digests.json"

Array = NDArray[np.float64]


def _sphere(count: int) -> Array:
    """Even points of the unit sphere."""
    turn = np.arange(count) + 0.5
    height = 1.0 - 2.0 * turn / count
    angle = turn * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _torus(count: int) -> Array:
    """Random points of a torus."""
    turn, tube = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, (2, count))
    ring = 3.0 + np.cos(tube)
    return np.stack([np.cos(turn) * ring, np.sin(turn) * ring, np.sin(tube)], axis=1)


def _noisy(count: int) -> Array:
    """Points of the sphere with Gaussian noise of 2 % of its radius."""
    return _sphere(count) + np.random.default_rng(2).normal(size=(count, 3)) * 0.02


def _frames(count: int, frames: int) -> Array:
    """Stacked frames of the sphere, each with noise of 3 % of its radius."""
    return np.concatenate([_sphere(count)] * frames) + np.random.default_rng(5).normal(
        size=(count * frames, 3), scale=0.03
    )


def _ground(side: int) -> Array:
    """A wavy square far from the origin, as of a georeferenced scan."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    flat = grid + rng.uniform(-0.3, 0.3, grid.shape)
    height = np.sin(flat[:, 0] / 9.0) * np.cos(flat[:, 1] / 7.0)
    return np.column_stack([flat, height]) + [5e5, 4e6, 100.0]


def _coloured() -> Cloud:
    points = _torus(2500)
    rng = np.random.default_rng(4)
    return Cloud(
        points,
        colors=rng.integers(0, 256, (2500, 3)).astype(np.uint8),
        scalars={
            "intensity": rng.random(2500, dtype=np.float32),
            "label": (points[:, 0] > 0).astype(np.uint8),
        },
    )


def _with_normals() -> Cloud:
    points = _sphere(1200)
    return Cloud(points, normals=(-points).astype(np.float32))


CASES: dict[str, tuple[Callable[[], Cloud], dict[str, Any]]] = {
    "sphere": (lambda: Cloud(_sphere(2000)), {"ratio": 4}),
    "sphere at 1": (lambda: Cloud(_sphere(1000)), {"ratio": 1}),
    "sphere at 16": (lambda: Cloud(_sphere(1500)), {"ratio": 16}),
    "sphere float32": (lambda: Cloud(_sphere(1500).astype(np.float32)), {"ratio": 2.5}),
    "given normals": (_with_normals, {"ratio": 3}),
    "colours and scalars": (_coloured, {"ratio": 4, "seed": 7}),
    "exact count": (lambda: Cloud(_torus(1800)), {"n_points": 9001}),
    "input kept": (lambda: Cloud(_torus(1800)), {"ratio": 5, "keep_input": True}),
    "viewpoint": (lambda: Cloud(_ground(40)), {"ratio": 4, "viewpoint": (5e5, 4e6, 1e4)}),
    "outward": (lambda: Cloud(_sphere(1500)), {"ratio": 4, "orient": "outward"}),
    "unoriented": (lambda: Cloud(_torus(1500)), {"ratio": 4, "orient": "none"}),
    "noise": (lambda: Cloud(_noisy(3000)), {"ratio": 4}),
    "noise kept": (lambda: Cloud(_noisy(1500)), {"ratio": 2, "keep_input": True}),
    "eight patches": (lambda: Cloud(_torus(16000)), {"ratio": 4}),
    "two tiles": (lambda: Cloud(_ground(80)), {"ratio": 8, "viewpoint": (5e5, 4e6, 1e4)}),
    "two noisy tiles": (lambda: Cloud(_noisy(6000)), {"ratio": 8}),
    "two tiles, input kept": (lambda: Cloud(_ground(80)), {"ratio": 8, "keep_input": True}),
    "averaged": (lambda: Cloud(_frames(1500, 12)), {"ratio": 2, "density": "even"}),
    "denoised": (lambda: Cloud(_frames(1500, 12)), {"ratio": 1, "denoise": True}),
}
_TILE = 4000  # points of the core of a tile in the cases of two tiles
MODELS = ("standard", "fast")


def platform() -> str:
    """The processor, and the versions of all that computes."""
    import llvmlite.binding
    import numba
    import scipy
    import torch

    parts = (torch, np, scipy, numba)
    versions = [f"{part.__name__} {part.__version__.partition('+')[0]}" for part in parts]
    return ", ".join([llvmlite.binding.get_host_cpu_name(), *versions])


def digest(upsampler: Upsampler, case: str) -> str:
    """The SHA-256 of everything that a case's answer holds."""
    make, options = CASES[case]
    plan = make_plan(make(), Options(**options), _TILE if case.startswith("two ") else None)
    cloud = upsampler.upsample(plan).cloud
    hashed = hashlib.sha256()
    named = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    for name, values in {**named, **cloud.scalars}.items():
        if values is not None:
            hashed.update(f"{name} {values.dtype} {values.shape}".encode())
            hashed.update(np.ascontiguousarray(values).data)
    return hashed.hexdigest()


def _all() -> Iterator[tuple[str, str]]:
    for model in MODELS:
        upsampler = Upsampler(model)
        for case in CASES:
            yield f"{model}: {case}", digest(upsampler, case)


def main() -> None:
    """Print the checksums of all cases, or record them."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--record", action="store_true", help=f"write them into {FILE.name}")
    chosen = parser.parse_args()
    found = dict(_all())
    if chosen.record:
        known = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}
        known[platform()] = found
        FILE.write_text(json.dumps(known, indent=1) + "\n", "utf-8")
    for case, value in found.items():
        print(value[:16], case)


if __name__ == "__main__":
    main()
