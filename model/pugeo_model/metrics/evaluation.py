# SPDX-License-Identifier: Apache-2.0
"""Evaluation of upsampling methods on fixed samples of shapes that were not trained on."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats import read
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.mesh.files import read_mesh
from pugeo_model.mesh.sampling import face_normals, poisson_disk, surface_area, uniform
from pugeo_model.metrics.clouds import (
    chamfer,
    evenness,
    hausdorff,
    jensen_shannon,
    nearest_both,
    sphere_distances,
)
from pugeo_model.metrics.reconstruction import Mesh, reconstruct

__all__ = [
    "CASES",
    "COLUMNS",
    "Case",
    "Measured",
    "Method",
    "Truth",
    "evaluate",
    "limit",
    "mean_row",
    "measure",
    "measure_normals",
    "measure_surface",
    "reference",
    "truths",
]

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
    "outward",
    "evenness",
    "CD#",
    "HD#",
    "JSD#",
    "stray",
    "density",
    "left",
)
"""CD, HD, JSD in 1e-2; P2F, sCD, sHD in 1e-3; normals in degrees, fractions in percent."""

_SURFACE_SAMPLES = 200_000

Method = Callable[[Cloud, float], Cloud]
"""An upsampling method: input cloud and ratio -> dense cloud."""


@dataclass(frozen=True)
class Case:
    """A kind of input with a ratio and the size of the reference.

    Attributes:
        kind: suffix of the input files, ``NAME_kind.ply``.
        ratio: upsampling ratio.
        reference: number of points of the reference, ``NAME_reference.ply``.
    """

    kind: str
    ratio: int
    reference: int

    @property
    def name(self) -> str:
        """Name of the case, such as ``5000 x4``."""
        return f"{self.kind} x{self.ratio}"


CASES = (
    Case("5000", 4, 20_000),
    Case("5000", 16, 80_000),
    Case("2048", 4, 8_192),
    Case("2048", 16, 32_768),
    Case("2048_noise01", 4, 8_192),
    Case("2048_noise02", 4, 8_192),
    Case("2048_random", 4, 8_192),
)


class Truth:
    """A true surface: a mesh with nearest points and samples.

    Args:
        path: a triangle mesh, longest side 1.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        self.vertices, self.faces = read_mesh(path)
        self.normals = face_normals(self.vertices, self.faces)
        self.distance = MeshDistance(self.vertices, self.faces)

    @cached_property
    def area(self) -> float:
        """Area of the mesh."""
        return surface_area(self.vertices, self.faces)

    @cached_property
    def sample(self) -> NDArray[np.float64]:
        """200,000 uniform samples, for the comparison with reconstructed surfaces."""
        rng = np.random.default_rng(_SURFACE_SAMPLES)
        return uniform(self.vertices, self.faces, _SURFACE_SAMPLES, rng)

    def even(self, count: int) -> Cloud:
        """Draw an independent Poisson-disk sample with true normals, the ideal result."""
        rng = np.random.default_rng(count)
        points = poisson_disk(self.vertices, self.faces, count, rng)
        _, face, _ = self.distance.nearest(points)
        return Cloud(points, normals=self.normals[face].astype(np.float32))


def truths(meshes: Path) -> Iterator[Truth]:
    """Load all ``NAME.ply`` of a folder, in the order of their names.

    Raises:
        FileNotFoundError: the folder has none.
    """
    found = sorted(meshes.glob("*.ply"))
    if not found:
        raise FileNotFoundError(f"no NAME.ply in {meshes}")
    return map(Truth, found)


def reference(truth: Truth, samples: Path, count: int) -> NDArray[np.float64]:
    """Poisson-disk sample of the true surface that outputs are compared with, ``(count, 3)``.

    The stored sample where there is one, else one that is the same every time.
    """
    stored = samples / "gt" / f"{truth.name}_{count}.ply"
    if stored.exists():
        return read(stored).points.astype(np.float64)
    return poisson_disk(truth.vertices, truth.faces, count, np.random.default_rng([count, 1]))


@dataclass(frozen=True, eq=False)
class Measured:
    """The result of a method for one input.

    Attributes:
        case: kind of input and ratio.
        truth: the shape.
        row: column -> value; for methods also ``seconds``.
        dense: the dense cloud.
        surface: the surface reconstructed from it, if requested.
    """

    case: Case
    truth: Truth
    row: dict[str, float]
    dense: Cloud
    surface: Mesh | None


def measure(
    points: NDArray[np.float64],
    normals: NDArray[np.floating] | None,
    reference: NDArray[np.float64],
    truth: Truth,
) -> dict[str, float]:
    """Compute all columns but those of the reconstructed surface.

    Args:
        points: ``(K, 3)``.
        normals: ``(K, 3)`` unit length; without them their columns are absent.
        reference: ``(K, 3)`` even sample of the surface.
        truth: the surface.
    """
    to_reference, to_prediction = nearest_both(points, reference)
    distance, face, _ = truth.distance.nearest(points)
    sphere_mean, sphere_max = sphere_distances(points, reference)
    row = {
        "CD": 1e2 * chamfer(to_reference, to_prediction),
        "HD": 1e2 * hausdorff(to_reference, to_prediction),
        "JSD": 1e2 * jensen_shannon(points, reference),
        "P2F": 1e3 * float(distance.mean()),
        "P2F_std": 1e3 * float(distance.std()),
        "sCD": 1e3 * sphere_mean,
        "sHD": 1e3 * sphere_max,
        "evenness": evenness(points),
    }
    if normals is not None:
        row |= measure_normals(normals, truth.normals[face])
    return row


def measure_normals(normals: NDArray[np.floating], true: NDArray[np.float64]) -> dict[str, float]:
    """Compute the columns of normals ``(K, 3)`` against true ones, both of unit length."""
    cosine = (normals * true).sum(axis=1)
    # arctan2, since arccos near 0 degrees amplifies float32 rounding to 0.02 degrees.
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(normals, true), axis=1), np.abs(cosine)))
    return {
        "normal_mean": float(angle.mean()),
        "normal_rms": float(np.sqrt((angle**2).mean())),
        "normal_below_10": 100.0 * float((angle < 10.0).mean()),
        "outward": 100.0 * float((cosine > 0.0).mean()),
    }


def measure_surface(surface: Mesh, truth: Truth) -> dict[str, float]:
    """Compute CD#, HD#, JSD# from 200,000 samples of a reconstructed and of the true surface.

    The samples are independent, so that CD# of a perfect surface is not 0 but about half of
    ``sqrt(area / 200000)``.
    """
    points = uniform(*surface, _SURFACE_SAMPLES, np.random.default_rng(0))
    to_reference, to_prediction = nearest_both(points, truth.sample)
    return {
        "CD#": 1e2 * chamfer(to_reference, to_prediction),
        "HD#": 1e2 * hausdorff(to_reference, to_prediction),
        "JSD#": 1e2 * jensen_shannon(points, truth.sample),
    }


def evaluate(
    method: Method,
    shapes: Sequence[Truth],
    samples: Path,
    cases: Sequence[Case] = CASES,
    *,
    surfaces: bool = False,
) -> Iterator[Measured]:
    """Evaluate a method for each case and shape.

    Args:
        method: the method.
        shapes: the true surfaces.
        samples: folder with ``inputs/NAME_kind.ply`` and ``gt/NAME_count.ply``.
        cases: kinds of input and ratios.
        surfaces: reconstruct surfaces and measure these too.
    """
    for case in cases:
        for truth in shapes:
            cloud = read(samples / "inputs" / f"{truth.name}_{case.kind}.ply")
            start = time.perf_counter()
            dense = method(cloud, case.ratio)
            seconds = time.perf_counter() - start
            row, surface = _measure_both(dense, case, truth, samples, surfaces=surfaces)
            yield Measured(case, truth, {**row, "seconds": seconds}, dense, surface)


def limit(
    shapes: Sequence[Truth],
    samples: Path,
    cases: Sequence[Case] = CASES,
    *,
    surfaces: bool = False,
) -> Iterator[Measured]:
    """Evaluate independent Poisson-disk samples of the true meshes; see :func:`evaluate`.

    They do not depend on the input, so that cases with references of one size share their rows.
    """
    for count in dict.fromkeys(case.reference for case in cases):
        same_size = [case for case in cases if case.reference == count]
        for truth in shapes:
            dense = truth.even(count)
            row, surface = _measure_both(dense, same_size[0], truth, samples, surfaces=surfaces)
            for case in same_size:
                yield Measured(case, truth, row, dense, surface)


def _measure_both(
    dense: Cloud, case: Case, truth: Truth, samples: Path, *, surfaces: bool
) -> tuple[dict[str, float], Mesh | None]:
    """Measure a dense cloud and, if requested, the surface reconstructed from it."""
    points = dense.points.astype(np.float64)
    row = measure(points, dense.normals, reference(truth, samples, case.reference), truth)
    if not surfaces or dense.normals is None:
        return row, None
    surface = reconstruct(points, dense.normals)
    return {**row, **measure_surface(surface, truth)}, surface


def mean_row(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Average rows (of shapes) by column; all rows have the columns of the first."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
