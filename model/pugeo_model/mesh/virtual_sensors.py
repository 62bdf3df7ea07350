# SPDX-License-Identifier: Apache-2.0
"""Virtual sensors: scans of meshes by ray casting (Embree through trimesh).

Lengths are those of the shape, whose longest side is 1. Each scan has a random resolution, noise
and place; noise, steps and misplacement are fractions of the spacing of its points.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn

__all__ = [
    "SENSORS",
    "Scan",
    "Scene",
    "Surface",
    "dense",
    "everywhere",
    "random_direction",
    "scan",
    "typical_spacing",
]

_GRAZING = 0.08  # cosine of incidence below which a beam gives no return
_FEWEST = 300  # points of a usable scan
_TOLERANCE = 2e-4  # distance from a hit to a surface point that the sensor sees


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with random points on it.

    Attributes:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        normals: ``(F, 3)`` float64 unit normals of the faces.
        pool: ``(n, 3)`` independent uniform samples.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    pool: NDArray[Any]


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan and the visible part of the true surface.

    Attributes:
        points: ``(M, 3)`` float64.
        noise: standard deviation of the points, in units of the shape.
        is_seen: returns of surface points ``(n, 3)`` which ones a sensor saw, ``(n,)`` bool.
        redundant: whether one chart may represent several points.
    """

    points: NDArray[np.float64]
    noise: float
    is_seen: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    redundant: bool = True


class Scene:
    """A mesh for ray casting.

    Args:
        surface: the mesh.
    """

    def __init__(self, surface: Surface) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False, validate=False)
        self.surface = surface
        self._caster = RayMeshIntersector(mesh)

    def cast(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Distances of the first hits of unit rays ``(n, 3)`` (infinite: none), and their faces."""
        origins = np.broadcast_to(origins, directions.shape)
        face = np.asarray(self._caster.intersects_first(origins, directions))
        hit = face >= 0
        normal = self.surface.normals[face[hit]]
        corner = self.surface.vertices[self.surface.faces[face[hit], 0]]
        slope = (directions[hit] * normal).sum(axis=1)
        slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        distance = np.full(len(directions), np.inf)
        # From the plane of the face in float64: Embree's own distances are float32.
        distance[hit] = ((corner - origins[hit]) * normal).sum(axis=1) / slope
        return distance, face

    def returns(
        self, origins: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Rows of the rays that return to the sensor, and the distances of their hits."""
        distance, face = self.cast(origins, directions)
        rows = np.flatnonzero(np.isfinite(distance) & (distance > 0.0))
        slope = np.abs((directions[rows] * self.surface.normals[face[rows]]).sum(axis=1))
        rows = rows[slope > _GRAZING]
        return rows, distance[rows]

    def sees(self, origins: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which surface points ``(n, 3)`` are visible from any of the origins ``(k, 3)``."""
        seen = np.zeros(len(points), dtype=np.bool_)
        for origin in origins:
            rest = np.flatnonzero(~seen)
            ray = points[rest] - origin
            length = np.linalg.norm(ray, axis=1)
            distance, _ = self.cast(origin, ray / length[:, None])
            seen[rest] = np.abs(distance - length) < _TOLERANCE + 1e-3 * length
        return seen


def _axes(origin: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Rows: direction to the centre of the shape, and two perpendicular ones, randomly turned."""
    forward = -origin / np.linalg.norm(origin)
    across = np.cross(forward, random_direction(rng))
    across /= np.linalg.norm(across)
    return np.stack([forward, across, np.cross(forward, across)])


def _fan(
    origin: NDArray[np.float64], fine: float, wide: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Unit directions ``(n, 3)`` at equal angles, ``fine`` and ``wide``, over the whole shape."""
    axes = _axes(origin, rng)
    reach = np.arctan(0.87 / np.linalg.norm(origin)) if np.linalg.norm(origin) > 0.9 else 0.8
    along = np.arange(-reach, reach, fine) + rng.random() * fine
    across = np.arange(-reach, reach, wide) + rng.random() * wide
    a, e = np.meshgrid(along, across)
    a, e = a.ravel()[:, None], e.ravel()[:, None]
    rays: NDArray[np.float64] = np.cos(e) * (np.cos(a) * axes[0] + np.sin(a) * axes[1])
    rays += np.sin(e) * axes[2]
    return rays


def _rings(scene: Scene, rng: np.random.Generator) -> Scan:
    """Scan of a spinning scanner: rings 2 to 8 times further apart than the points along them."""
    origin = random_direction(rng) * rng.uniform(1.2, 2.5)
    far = float(np.linalg.norm(origin))
    spacing = rng.uniform(0.008, 0.022)  # root of the area a beam has
    uneven = rng.uniform(2.0, 8.0)
    rays = _fan(origin, spacing / np.sqrt(uneven) / far, spacing * np.sqrt(uneven) / far, rng)
    rows, distance = scene.returns(origin, rays)
    noise = rng.uniform(0.0, 0.25) * spacing
    points = origin + rays[rows] * (distance + rng.normal(0.0, noise, len(rows)))[:, None]
    return Scan(points, noise, lambda at: scene.sees(origin[None], at))


def _depth(scene: Scene, rng: np.random.Generator) -> Scan:
    """Scan of a depth camera: pixels, depth in steps of disparity, noise before the steps."""
    origin = random_direction(rng) * rng.uniform(1.2, 2.2)
    axes, far = _axes(origin, rng), float(np.linalg.norm(origin))
    spacing = rng.uniform(0.007, 0.018)
    side = np.arange(-0.65 / far, 0.65 / far, spacing / far)
    x, y = np.meshgrid(side, side)
    rays = axes[0] + x.reshape(-1, 1) * axes[1] + y.reshape(-1, 1) * axes[2]
    length = np.linalg.norm(rays, axis=1)
    rows, distance = scene.returns(origin, rays / length[:, None])
    depth = distance / length[rows]
    step = rng.uniform(0.0, 1.2) * spacing * rng.choice([0.3, 1.0])
    blur = rng.uniform(0.0, 0.25) * spacing
    # Disparity is the inverse of depth: steps grow with the square of it.
    disparity = far * far / depth + rng.normal(0.0, blur, len(depth))
    if step > 1e-5:
        disparity = (np.floor(disparity / step) + 0.5) * step
    points = origin + rays[rows] * (far * far / disparity)[:, None]
    frames = int(rng.choice([1, 1, 1, 2, 4]))
    if frames > 1:
        more = [points]
        for _ in range(frames - 1):
            # Frames one after the other: the same rays, another noise.
            again = disparity + rng.normal(0.0, max(blur, 0.05 * spacing), len(depth))
            more.append(origin + rays[rows] * (far * far / again)[:, None])
        points = np.concatenate(more)
    noise = float(np.hypot(step / np.sqrt(12.0), blur))
    return Scan(points, noise, lambda at: scene.sees(origin[None], at))


def _stations(scene: Scene, rng: np.random.Generator) -> Scan:
    """Scans from two to four stations, each misplaced by a fraction of a spacing."""
    spacing = rng.uniform(0.012, 0.03)
    noise, off = rng.uniform(0.0, 0.12) * spacing, rng.uniform(0.0, 0.15) * spacing
    parts, origins = [], []
    for _ in range(int(rng.integers(2, 5))):
        origin = random_direction(rng) * rng.uniform(1.2, 2.5)
        angle = float(spacing / np.linalg.norm(origin) * rng.uniform(0.7, 1.4))
        rays = _fan(origin, angle, angle, rng)
        rows, distance = scene.returns(origin, rays)
        part = origin + rays[rows] * (distance + rng.normal(0.0, noise, len(rows)))[:, None]
        parts.append(part + rng.normal(0.0, off, 3))
        origins.append(origin)
    places = np.array(origins)
    return Scan(
        np.concatenate(parts), float(np.hypot(noise, off)), lambda at: scene.sees(places, at)
    )


def _strips(scene: Scene, rng: np.random.Generator) -> Scan:
    """Scan from the air: parallel lines in one strip or two, the second one too high."""
    up = random_direction(rng)
    axes = _axes(up, rng)
    spacing, uneven = rng.uniform(0.008, 0.02), rng.uniform(1.5, 5.0)
    fine, wide = spacing / np.sqrt(uneven), spacing * np.sqrt(uneven)
    noise, lift = rng.uniform(0.0, 0.15) * spacing, rng.uniform(-0.3, 0.3) * spacing
    parts, origins = [], []
    for strip in range(int(rng.integers(1, 3))):
        side = rng.uniform(-0.4, 0.4)
        along = np.arange(-0.87, 0.87, wide) + rng.random() * wide
        angle = np.arange(-0.45, 0.45, fine / 2.0) + rng.random() * fine / 2.0
        a, s = np.meshgrid(angle, along)
        a, s = a.reshape(-1, 1), s.reshape(-1, 1)
        starts = 2.0 * up + side * axes[1] + s * axes[2]
        rays = -np.cos(a) * up + np.sin(a) * axes[1]
        rows, distance = scene.returns(starts, rays)
        moved = distance + rng.normal(0.0, noise, len(rows))
        parts.append(starts[rows] + rays[rows] * moved[:, None] + strip * lift * up)
        origins += [2.0 * up + side * axes[1] + y * axes[2] for y in (-0.5, -0.25, 0, 0.25, 0.5)]
    places = np.array(origins)
    return Scan(
        np.concatenate(parts), float(np.hypot(noise, lift / 2)), lambda at: scene.sees(places, at)
    )


def _photos(scene: Scene, rng: np.random.Generator) -> Scan:
    """Photogrammetric cloud: varying density, noise, stray points, small holes."""
    pool = scene.surface.pool.astype(np.float64)
    wave = np.zeros(len(pool))
    for _ in range(6):
        wave += np.cos(pool @ rng.normal(0.0, 5.0, 3) + rng.uniform(0.0, 2.0 * np.pi))
    weight = np.exp(rng.uniform(0.1, 0.5) * wave)
    count = int(rng.choice([2500, 5000, 8000]))
    points = pool[rng.choice(len(pool), count, replace=False, p=weight / weight.sum())]
    for _ in range(int(rng.integers(0, 4))):
        middle = points[rng.integers(len(points))]
        points = points[np.linalg.norm(points - middle, axis=1) > rng.uniform(0.01, 0.04)]
    noise = rng.uniform(0.0, 0.3) * typical_spacing(points)
    points = points + rng.normal(0.0, noise, points.shape)
    low, high = points.min(axis=0) - 0.02, points.max(axis=0) + 0.02
    stray = rng.uniform(low, high, (int(len(points) * rng.uniform(0.0, 0.015)), 3))
    return Scan(np.concatenate([points, stray]), noise, everywhere)


def _voxels(scene: Scene, rng: np.random.Generator) -> Scan:
    """Voxel grid: one point per voxel, at its centre or at the mean of its samples."""
    size = rng.uniform(0.012, 0.03)
    pool = scene.surface.pool.astype(np.float64) + rng.normal(0.0, rng.uniform(0.0, 0.1) * size, 3)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    local = pool @ turned
    keys = np.floor(local / size).astype(np.int64)
    number = ((keys[:, 0] << 20) + keys[:, 1] << 20) + keys[:, 2]
    _, first, owner = np.unique(number, return_index=True, return_inverse=True)
    if rng.random() < 0.5:
        points = (keys[first] + 0.5) * size
        noise = 0.29 * size
    else:
        mass = np.bincount(owner)
        points = np.stack([np.bincount(owner, c) / mass for c in local.T], axis=1)
        noise = 0.02 * size
    return Scan(points @ turned.T, noise, everywhere)


def _lattice(scene: Scene, rng: np.random.Generator) -> Scan:
    """Elevation model: a square grid from one side, with noise along the view."""
    up = random_direction(rng)
    axes = _axes(up, rng)
    spacing = rng.uniform(0.009, 0.02)
    side = np.arange(-0.87, 0.87, spacing)
    x, y = np.meshgrid(side, side)
    starts = 2.0 * up + x.reshape(-1, 1) * axes[1] + y.reshape(-1, 1) * axes[2]
    rays = np.broadcast_to(-up, starts.shape)
    rows, distance = scene.returns(starts, rays)
    noise = rng.uniform(0.0, 0.45) * spacing
    points = starts[rows] - up * (distance + rng.normal(0.0, noise, len(rows)))[:, None]
    places = 50.0 * up[None]
    return Scan(points, noise, lambda at: scene.sees(places, at))


def dense(pool: NDArray[Any], rng: np.random.Generator) -> Scan:
    """Many points of a pool ``(n, 3)``, with noise of up to two spacings."""
    count = int(rng.choice([8000, 16000, 32000, 50000]))
    points = pool[rng.choice(len(pool), count, replace=False)].astype(np.float64)
    noise = min(rng.uniform(0.25, 2.0) * typical_spacing(points), 0.012)
    return Scan(points + rng.normal(0.0, noise, points.shape), noise, everywhere)


SENSORS: dict[str, Callable[[Scene, np.random.Generator], Scan]] = {
    "rings": _rings,
    "depth": _depth,
    "stations": _stations,
    "strips": _strips,
    "photos": _photos,
    "voxels": _voxels,
    "lattice": _lattice,
}
"""Sensors by name."""


def scan(scene: Scene, rng: np.random.Generator) -> Scan | None:
    """Scan with a random sensor; ``None`` if it sees hardly anything."""
    sensor = list(SENSORS.values())[rng.integers(len(SENSORS))]
    made = sensor(scene, rng)
    return made if len(made.points) >= _FEWEST else None


def everywhere(at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return ``True`` for all surface points ``(n, 3)``."""
    return np.ones(len(at), dtype=np.bool_)


def random_direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """Random unit vector ``(3,)``."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def typical_spacing(points: NDArray[np.float64]) -> float:
    """Median spacing (mean distance to 8 neighbours) of about 200 of the points ``(M, 3)``."""
    distance, _ = knn(cKDTree(points), points[:: max(1, len(points) // 200)], 9)
    return float(np.median(distance[:, 1:].mean(axis=1)))
