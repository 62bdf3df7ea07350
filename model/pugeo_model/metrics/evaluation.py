# SPDX-License-Identifier: Apache-2.0
"""Measures of the network on fixed samples of shapes it was not trained on."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read
from pugeo_model.metrics.clouds import (
    chamfer,
    evenness,
    hausdorff,
    jensen_shannon,
    nearest_both,
    sphere_distances,
)
from pugeo_model.metrics.surface_distance import MeshDistance
from pugeo_model.training.corpus import face_normals, poisson_disk

__all__ = ["CASES", "COLUMNS", "Case", "evaluate", "limit", "mean_row", "measure"]

COLUMNS = (
    "CD",
    "HD",
    "JSD",
    "P2F",
    "P2F_std",
    "sCD",
    "sHD",
    "normal_mean",
    "normal_rms",
    "normal_below_10",
    "evenness",
)
"""CD, HD, JSD in 1e-2; P2F, sCD, sHD in 1e-3; normals in degrees, their share in percent."""


@dataclass(frozen=True)
class Case:
    """One row of the table: input samples, ratio, size of the reference.

    Attributes:
        kind: suffix of the input files, ``NAME_kind.ply``.
        ratio: upsampling ratio.
        reference: points of the reference, ``NAME_reference.ply``.
    """

    kind: str
    ratio: int
    reference: int

    @property
    def name(self) -> str:
        """Such as ``5000 x4``."""
        return f"{self.kind} x{self.ratio}"


CASES = (
    Case("5000", 4, 20_000),
    Case("5000", 16, 80_000),
    Case("2048", 4, 8_192),
    Case("2048_noise01", 4, 8_192),
    Case("2048_noise02", 4, 8_192),
    Case("2048_random", 4, 8_192),
)


class Truth:
    """A mesh and its nearest points."""

    def __init__(self, path: Path) -> None:
        vertices, faces = igl.read_triangle_mesh(str(path))
        self.vertices, self.faces = vertices.astype(np.float64), faces.astype(np.int64)
        self.normals = face_normals(self.vertices, self.faces)
        self.distance = MeshDistance(self.vertices, self.faces)


def measure(
    points: NDArray[np.float64],
    normals: NDArray[np.float32] | None,
    reference: NDArray[np.float64],
    truth: Truth,
) -> dict[str, float]:
    """All columns for one dense cloud; normals' columns are absent where there are none."""
    there, back = nearest_both(points, reference)
    distance, face, _ = truth.distance.nearest(points)
    sphere_mean, sphere_max = sphere_distances(points, reference)
    row = {
        "CD": 1e2 * chamfer(there, back),
        "HD": 1e2 * hausdorff(there, back),
        "JSD": 1e2 * jensen_shannon(points, reference),
        "P2F": 1e3 * float(distance.mean()),
        "P2F_std": 1e3 * float(distance.std()),
        "sCD": 1e3 * sphere_mean,
        "sHD": 1e3 * sphere_max,
        "evenness": evenness(points),
    }
    if normals is not None:
        cosine = np.abs((normals * truth.normals[face]).sum(axis=1)).clip(0.0, 1.0)
        angle = np.degrees(np.arccos(cosine))
        row["normal_mean"] = float(angle.mean())
        row["normal_rms"] = float(np.sqrt((angle**2).mean()))
        row["normal_below_10"] = 100.0 * float((angle < 10.0).mean())
    return row


def evaluate(
    upsample: Callable[[Cloud, float], Cloud],
    meshes: Path,
    samples: Path,
    cases: Sequence[Case] = CASES,
) -> Iterator[tuple[Case, str, dict[str, float]]]:
    """Measure case by case and shape by shape.

    Args:
        upsample: the method.
        meshes: folder of ``NAME.ply``, longest side 1.
        samples: folder with ``inputs/NAME_kind.ply`` and ``gt/NAME_count.ply``.
        cases: rows wanted.

    Yields:
        Case, shape, and its columns with the ``seconds`` taken.
    """
    truths = {path.stem: Truth(path) for path in sorted(meshes.glob("*.ply"))}
    for case in cases:
        for name, truth in truths.items():
            cloud = read(samples / "inputs" / f"{name}_{case.kind}.ply")
            reference = read(samples / "gt" / f"{name}_{case.reference}.ply").points
            begun = time.perf_counter()
            dense = upsample(cloud, case.ratio)
            seconds = time.perf_counter() - begun
            row = measure(
                dense.points.astype(np.float64),
                dense.normals,
                reference.astype(np.float64),
                truth,
            )
            yield case, name, {**row, "seconds": seconds}


def limit(
    meshes: Path, samples: Path, cases: Sequence[Case] = CASES
) -> Iterator[tuple[Case, str, dict[str, float]]]:
    """The same columns for an independent Poisson-disk sample of the true mesh."""
    for path in sorted(meshes.glob("*.ply")):
        truth = Truth(path)
        for case in cases:
            rng = np.random.default_rng(case.reference)
            points = poisson_disk(truth.vertices, truth.faces, case.reference, rng)
            reference = read(samples / "gt" / f"{path.stem}_{case.reference}.ply").points
            yield case, path.stem, measure(points, None, reference.astype(np.float64), truth)


def mean_row(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Mean over shapes of every column they share."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
