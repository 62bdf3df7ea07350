# SPDX-License-Identifier: Apache-2.0
"""Quality on scans of virtual sensors, at R = 4: nearness, stray points, normals, density."""

import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.mesh.virtual_sensors import SENSORS, Scan, Scene, Surface
from pugeo_model.metrics.evaluation import Truth, measure_normals
from pugeo_model.upsampler import Upsampler

__all__ = ["rows"]

_RATIO = 4.0
_STRAY = 0.01  # distance from the surface beyond which a point is stray
_POOL = 60_000  # random points that photos are made of
_PLACES = 4000  # of the seen surface around which points are counted
_REACH = 4.0  # spacings within which they are counted


def rows(upsampler: Upsampler, truth: Truth) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Measure one shape in all sensors: yields sensor, method and columns.

    The method ``input`` is the scan itself, ``even`` the answer with ``density=even``, ``limit`` an
    even sample of the seen surface.
    """
    pool = truth.sample[:_POOL]
    scene = Scene(Surface(truth.vertices, truth.faces, truth.normals, pool))
    for name, sensor in SENSORS.items():
        # The same scan of a shape in every run, of another resolution and place for each shape.
        scan = sensor(scene, np.random.default_rng(zlib.crc32(f"{name} {truth.name}".encode())))
        seen = truth.sample[scan.is_seen(truth.sample)]
        cloud = Cloud(scan.points.astype(np.float32))
        yield name, "input", _measure(cloud, truth, seen)
        yield name, "ours", _measure(upsampler(cloud, _RATIO).cloud, truth, seen)
        even = upsampler(cloud, _RATIO, density="even").cloud
        yield name, "even", _measure(even, truth, seen)
        yield name, "limit", _limit(scan, truth, seen)


def _measure(cloud: Cloud, truth: Truth, seen: NDArray[np.float64]) -> dict[str, float]:
    points = cloud.points.astype(np.float64)
    distance, face, _ = truth.distance.nearest(points)
    row = {
        "P2F": 1e3 * float(distance.mean()),
        "stray": 100.0 * float((distance > _STRAY).mean()),
        "density": _density_variation(points, truth, seen),
    }
    if cloud.normals is not None:
        found = measure_normals(cloud.normals, truth.normals[face])
        row |= {name: found[name] for name in ("normal_mean", "outward")}
    return row


def _density_variation(
    points: NDArray[np.float64], truth: Truth, seen: NDArray[np.float64]
) -> float:
    """Standard deviation over mean of the points around places on the seen surface."""
    area = truth.area * len(seen) / len(truth.sample)
    reach = _REACH * np.sqrt(area / len(points))
    places = seen[:: max(1, len(seen) // _PLACES)]
    counts = cKDTree(points).query_ball_point(places, reach, return_length=True)
    return float(np.std(counts) / np.mean(counts))


def _limit(scan: Scan, truth: Truth, seen: NDArray[np.float64]) -> dict[str, float]:
    """An even sample of the whole surface, of which the seen part is kept."""
    share = len(seen) / len(truth.sample)
    even = truth.even(round(_RATIO * len(scan.points) / share))
    return _measure(even.take(np.flatnonzero(scan.is_seen(even.points))), truth, seen)
