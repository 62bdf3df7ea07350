# SPDX-License-Identifier: Apache-2.0
"""Answers on closed forms in the patterns of sensors, against their exact surface.

``python -m benchmarks.sensor_patterns`` prints a table: root mean square errors of scan and answer,
and angles of the normals. The tests hold bounds of the same patterns.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pugeo_model.cloud import Cloud
from pugeo_model.upsampler import Upsampler

__all__ = ["Answer", "Pattern", "measure", "patterns"]

Array = NDArray[np.float64]
Truth = Callable[[Array], tuple[Array, Array]]
"""Signed distances ``(n,)`` of points from a surface, and its normals ``(n, 3)`` there."""

_FOCAL, _BASELINE = 570.0, 0.075  # pixels, metres
_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Pattern:
    """A scan of a surface.

    Attributes:
        name: of the pattern, then its numbers.
        points: ``(n, 3)`` float64.
        truth: the surface.
        viewpoint: of the scanner; ``None`` if it is not given.
    """

    name: str
    points: Array
    truth: Truth
    viewpoint: tuple[float, float, float] | None


@dataclass(frozen=True)
class Answer:
    """Figures of an answer.

    Attributes:
        scan: root mean square distance of the scan from the surface.
        error: the same of the answer.
        degrees: mean angle of the normals, whatever their signs.
        facing: share of the normals on the right side.
    """

    scan: float
    error: float
    degrees: float
    facing: float


def measure(upsampler: Upsampler, pattern: Pattern, ratio: float = 4.0) -> Answer:
    """Upsample a pattern and compare the answer with the surface."""
    dense = upsampler(Cloud(pattern.points), ratio, viewpoint=pattern.viewpoint).cloud
    error, normals = pattern.truth(dense.points)
    assert dense.normals is not None
    cosine = np.einsum("ni,ni->n", dense.normals, normals)
    return Answer(
        float(np.sqrt(np.mean(pattern.truth(pattern.points)[0] ** 2))),
        float(np.sqrt(np.mean(error**2))),
        float(np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))).mean()),
        float(np.mean(cosine > 0.0)),
    )


def patterns() -> Iterator[Pattern]:
    """All patterns; the same in every run."""
    for tilt in (0.1, 0.3, 0.6):
        for step in (0.001, 0.003):
            yield _depth_steps(tilt, step)
    for noise in (0.0, 0.3):
        for tilt in (0.2, 0.7):
            yield _disparity_steps(tilt, noise, turned=False)
    for tilt in (0.2, 0.7):
        yield _disparity_steps(tilt, 0.0, turned=True)
    for kind in ("square", "hexagonal", "brick", "holes", "random"):
        for noise in (0.1, 0.3, 0.6):
            yield _flat_noise(kind, noise)
    for noise in (0.3, 0.6):
        yield _noise_in_one_half(noise)
    for frames in (2, 3, 10, 20, 30):
        yield _stacked_frames(frames)
    for noise in (0.02, 0.05):
        yield _rings(noise)
    for count in (2500, 20_000):
        for noise in (0.05, 0.1):
            yield _ball(count, noise)
    yield _cylinder()


def _plane(normal: Array, distance: float) -> Truth:
    return lambda points: (points @ normal - distance, np.broadcast_to(normal, points.shape))


_GROUND = _plane(np.array([0.0, 0.0, 1.0]), 0.0)


def _from_camera(depth: Array) -> Array:
    """Points ``(n, 3)`` of a depth image, metres, seen from the origin along z."""
    rows, columns = depth.shape
    u, v = np.meshgrid(np.arange(columns) - columns / 2, np.arange(rows) - rows / 2)
    return np.stack([u / _FOCAL * depth, v / _FOCAL * depth, depth], -1).reshape(-1, 3)


def _wall(tilt: float, roll: float, distance: float) -> tuple[Array, Array, float]:
    """Exact depth image of a wall, its normal towards the camera, and its distance along it."""
    normal = np.array([np.sin(tilt), roll, np.cos(tilt)])
    normal /= np.linalg.norm(normal)
    u, v = np.meshgrid(np.arange(120) - 60, np.arange(90) - 45)
    slope = normal[0] * u / _FOCAL + normal[1] * v / _FOCAL + normal[2]
    return normal[2] * distance / slope, -normal, float(-normal[2] * distance)


def _depth_steps(tilt: float, step: float) -> Pattern:
    """A wall whose depth is rounded; a terrace is up to seventeen points wide."""
    depth, normal, distance = _wall(tilt, 0.0, 1.0)
    points = _from_camera(np.round(depth / step) * step)
    return Pattern(f"depth steps {step} tilt {tilt}", points, _plane(normal, distance), _ORIGIN)


def _disparity_steps(tilt: float, noise: float, *, turned: bool) -> Pattern:
    """A wall with steps of an eighth of a pixel of disparity; noise in steps."""
    rng = np.random.default_rng(1)
    depth, normal, distance = _wall(tilt, 0.2, 2.0)
    disparity = _FOCAL * _BASELINE * 8.0 / depth + rng.normal(size=depth.shape) * noise
    points = _from_camera(_FOCAL * _BASELINE * 8.0 / np.round(disparity))
    name = f"disparity steps tilt {tilt} noise {noise}"
    if turned:
        turn = Rotation.random(random_state=3).as_matrix()
        points, normal = points @ turn.T, turn @ normal
        name += " turned"
    return Pattern(name, points, _plane(normal, distance), _ORIGIN)


def _places(kind: str) -> Array:
    """Places ``(n, 2)`` on a plane, at a distance of about 1."""
    places = np.stack(np.meshgrid(np.arange(50.0), np.arange(50.0)), -1)
    if kind in {"brick", "hexagonal"}:
        places[1::2, :, 0] += 0.5
    if kind == "hexagonal":
        places[..., 1] *= np.sqrt(0.75)
    places = places.reshape(-1, 2)
    rng = np.random.default_rng(2)
    if kind == "holes":
        places = places[rng.random(len(places)) < 0.7]
    if kind == "random":
        places = rng.uniform(0.0, 50.0, places.shape)
    return places


def _flat_noise(kind: str, noise: float) -> Pattern:
    """Noise along the view on a plane that is sampled in any way."""
    places = _places(kind)
    height = np.random.default_rng(3).normal(size=len(places)) * noise
    return Pattern(f"{kind} noise {noise}", np.c_[places, height], _GROUND, (25.0, 25.0, 1e4))


def _noise_in_one_half(noise: float) -> Pattern:
    """A scan that is exact in one half and noisy in the other."""
    places = _places("square")
    height = np.random.default_rng(3).normal(size=len(places)) * noise * (places[:, 0] > 25.0)
    return Pattern(f"half noise {noise}", np.c_[places, height], _GROUND, (25.0, 25.0, 1e4))


def _stacked_frames(frames: int) -> Pattern:
    """As many points on every ray as there are frames."""
    places = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), -1).reshape(-1, 2)
    rng = np.random.default_rng(3)
    points = [np.c_[places, rng.normal(size=len(places)) / 3.0] for _ in range(frames)]
    return Pattern(f"frames {frames}", np.concatenate(points), _GROUND, (20.0, 20.0, 3e4))


def _rings(noise: float) -> Pattern:
    """Ground below a spinning scanner, with noise along its rays; metres.

    Each ring alone is a ribbon, tilted like its beam.
    """
    azimuth, elevation = np.meshgrid(
        np.deg2rad(np.arange(0.0, 120.0, 0.17)), np.deg2rad(np.arange(3.0, 26.0))
    )
    distance = 1.7 / np.sin(elevation)
    distance += np.random.default_rng(7).normal(size=distance.shape) * noise
    across = distance * np.cos(elevation)
    points = [
        across * np.cos(azimuth),
        across * np.sin(azimuth),
        1.7 - distance * np.sin(elevation),
    ]
    return Pattern(
        f"rings noise {noise}", np.stack(points, -1).reshape(-1, 3), _GROUND, (0.0, 0.0, 1.7)
    )


def _ball(count: int, noise: float) -> Pattern:
    """A ball of radius 1 with a noise of several spacings."""

    def truth(points: Array) -> tuple[Array, Array]:
        length = np.linalg.norm(points, axis=1)
        return length - 1.0, points / length[:, None]

    rng = np.random.default_rng(5)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= 1.0 + rng.normal(size=(count, 1)) * noise
    return Pattern(f"ball {count} noise {noise}", points, truth, None)


def _cylinder() -> Pattern:
    """Rings around a cylinder, five times as far apart as their points."""

    def truth(points: Array) -> tuple[Array, Array]:
        across = points * [1.0, 1.0, 0.0]
        length = np.linalg.norm(across, axis=1)
        return length - 1.0, across / length[:, None]

    rng = np.random.default_rng(6)
    angle, height = np.meshgrid(np.arange(0.0, 2.0 * np.pi, 0.02), np.arange(0.0, 3.0, 0.1))
    radius = 1.0 + rng.normal(size=angle.shape) * 0.007
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    return Pattern("lines on a cylinder", points.reshape(-1, 3), truth, None)


def main() -> None:
    """Print the table."""
    upsampler = Upsampler()
    print("| pattern | error left | normals ° | right side % |")
    print("|---|---:|---:|---:|")
    for pattern in patterns():
        answer = measure(upsampler, pattern)
        print(
            f"| {pattern.name} | {answer.error / answer.scan:.2f} | {answer.degrees:.1f} | "
            f"{100.0 * answer.facing:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
