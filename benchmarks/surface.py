# SPDX-License-Identifier: Apache-2.0
"""A closed bumpy surface given by a formula: its samples, distances to it, its normals.

The radius in direction ``d`` is ``r(d) = 1 + sum of a sin(k . d + p)``. Nothing has to be
downloaded, the truth is exact, and any number of points can be asked for.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.resample.elimination import eliminate, packing_radius

__all__ = ["distances", "normals", "sample", "spiral"]

Floats = NDArray[np.float64]

_WAVES = np.random.default_rng(7)
_K = _WAVES.normal(size=(6, 3)) * 4.5  # waves of about 15 points where there are 5,000
_PHASE = _WAVES.uniform(0.0, 2.0 * np.pi, 6)
_HEIGHT = 0.045
_CANDIDATES = 5  # a kept sample, as Yuksel advises for sample elimination
_CROWD = 28  # longest list of neighbours among candidates


def _radius(directions: Floats) -> Floats:
    """``r(d)`` of unit vectors, ``(n, 3)`` -> ``(n,)``."""
    radius: Floats = 1.0 + _HEIGHT * np.sin(directions @ _K.T + _PHASE).sum(axis=1)
    return radius


def _gradient(points: Floats) -> Floats:
    """Gradient of ``F(x) = |x| - r(x / |x|)``, ``(n, 3)``."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    unit = points / length
    slope = _HEIGHT * np.cos(unit @ _K.T + _PHASE) @ _K
    across = slope - (slope * unit).sum(axis=1, keepdims=True) * unit
    gradient: Floats = unit - across / length
    return gradient


def distances(points: Floats) -> Floats:
    """Distance to the surface to first order, ``|F| / |grad F|``, ``(n, 3)`` -> ``(n,)``."""
    length = np.linalg.norm(points, axis=1)
    above = np.abs(length - _radius(points / length[:, None]))
    near: Floats = above / np.linalg.norm(_gradient(points), axis=1)
    return near


def normals(points: Floats) -> Floats:
    """Outward unit normals of the surface at points on or near it, ``(n, 3)``."""
    gradient = _gradient(points)
    unit: Floats = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    return unit


def sample(count: int, seed: int = 0) -> Floats:
    """An even sample of exactly ``count`` points, ``(count, 3)``.

    Uniform candidates by rejection, then sample elimination, as the training inputs are made.
    """
    rng = np.random.default_rng(seed)
    candidates = _uniform(_CANDIDATES * count, rng)
    reach = np.full(len(candidates), packing_radius(np.array(_area() / count)))
    far, rows = cKDTree(candidates).query(candidates, _CROWD, distance_upper_bound=reach[0])
    crowd = np.where(np.isfinite(far), rows, -1)[:, 1:].astype(np.int32)  # the first is itself
    return candidates[eliminate(candidates, crowd, reach, count)]


def spiral(count: int) -> Floats:
    """A fairly even sample of any size in no time, ``(count, 3)``: a spiral of directions."""
    turn = np.arange(count) + 0.5
    height = 1.0 - 2.0 * turn / count
    ring = np.sqrt(1.0 - height * height)
    angle = turn * (np.pi * (3.0 - np.sqrt(5.0)))
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    found: Floats = directions * _radius(directions)[:, None]
    return found


def _stretch(directions: Floats) -> Floats:
    """Surface area over solid angle, ``(n, 3)`` -> ``(n,)``: ``r^2`` over the cosine of tilt."""
    radius = _radius(directions)
    tilt = (normals(directions * radius[:, None]) * directions).sum(axis=1)
    stretch: Floats = radius**2 / tilt
    return stretch


def _area() -> float:
    directions = _directions(200_000, np.random.default_rng(1))
    return 4.0 * np.pi * float(_stretch(directions).mean())


def _uniform(count: int, rng: np.random.Generator) -> Floats:
    """Independent samples, uniform by area, ``(count, 3)``."""
    kept: list[Floats] = []
    while sum(map(len, kept)) < count:
        directions = _directions(2 * count, rng)
        stretch = _stretch(directions)
        chosen = directions[rng.random(len(directions)) < stretch / stretch.max()]
        kept.append(chosen * _radius(chosen)[:, None])
    return np.concatenate(kept)[:count]


def _directions(count: int, rng: np.random.Generator) -> Floats:
    vectors = rng.normal(size=(count, 3))
    unit: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit
