# SPDX-License-Identifier: Apache-2.0
"""The paper's three robustness figures: few random points, noise, a LiDAR frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.neighbours import knn
from pugeo_model.mesh.sampling import uniform
from pugeo_model.metrics.clouds import chamfer, nearest_both
from pugeo_model.metrics.evaluation import Truth
from pugeo_model.metrics.pictures import upright
from pugeo_model.metrics.rasteriser import BACKGROUND, Camera, splat

__all__ = ["FEW", "NOISE", "Shown", "draw", "few_points", "lidar", "noisy_points"]

FEW = 128
"""Random points of the non-uniform inputs."""

NOISE = (0.0, 0.005, 0.01, 0.02)
"""Standard deviations of the noise, in longest sides of a shape; the paper gives no values."""

_RATIO = 16
_REFERENCE = 20_000  # independent samples of the true surface
_CLAY = np.array([0.62, 0.60, 0.56])
_KITTI_SIDE = 16.0  # metres, of the part of the frame that is shown

Floats = NDArray[np.float64]
Method = Callable[[Cloud, float], Cloud]


@dataclass(frozen=True, eq=False)
class Shown:
    """An input and what came out, as a figure shows them.

    Attributes:
        name: of the shape and the case.
        sparse: the input.
        dense: the output.
        turn: ``(3, 3)`` rotation that puts the shape upright.
        figures: CD in 1e-2 and P2F in 1e-3 of the output, and of the input; empty without a truth.
    """

    name: str
    sparse: Cloud
    dense: Cloud
    turn: Floats
    figures: dict[str, float]


def few_points(method: Method, truth: Truth) -> Shown:
    """128 independent random points of a shape, 16 times as many out."""
    points = uniform(truth.vertices, truth.faces, FEW, np.random.default_rng(FEW))
    return _shown(f"{truth.name}, {FEW} random points", method, points, truth)


def noisy_points(method: Method, truth: Truth, sigma: float, count: int = 1024) -> Shown:
    """Independent random points with Gaussian noise, 16 times as many out.

    The paper's figure starts from 128 points, of which most shapes here are past recognition; more
    are taken, as random.
    """
    rng = np.random.default_rng([count, round(1e4 * sigma)])
    points = uniform(truth.vertices, truth.faces, count, rng)
    points += rng.normal(0.0, sigma, points.shape)
    return _shown(f"{truth.name}, noise {100 * sigma:g} %", method, points, truth)


def lidar(method: Method, frame: Path) -> Shown:
    """The nearest part of a KITTI Velodyne frame, float32 x, y, z, intensity; no truth.

    Raises:
        ValueError: the file is no such frame.
    """
    raw = np.fromfile(frame, dtype=np.float32)
    if raw.size == 0 or raw.size % 4:
        raise ValueError(f"{frame} holds no float32 x, y, z, intensity")
    points = raw.reshape(-1, 4)[:, :3].astype(np.float64)
    ahead = (points[:, 0] > 0) & (points[:, 0] < _KITTI_SIDE)
    part = points[ahead & (np.abs(points[:, 1]) < _KITTI_SIDE / 2)]
    if not len(part):
        raise ValueError(f"{frame} has no point within {_KITTI_SIDE:g} m ahead")
    dense = method(Cloud(part), _RATIO)
    # The sensor looks along x, z is up; the picture looks along -z, y is up.
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    return Shown("KITTI", Cloud(part), dense, turn, {})


def _shown(name: str, method: Method, points: Floats, truth: Truth) -> Shown:
    dense = method(Cloud(points), _RATIO)
    rng = np.random.default_rng(_REFERENCE)
    true = uniform(truth.vertices, truth.faces, _REFERENCE, rng)
    figures = {}
    for which, cloud in (("output", dense.points.astype(np.float64)), ("input", points)):
        figures[f"CD {which}"] = 1e2 * chamfer(*nearest_both(cloud, true))
        figures[f"P2F {which}"] = 1e3 * float(truth.distance.nearest(cloud)[0].mean())
    return Shown(name, Cloud(points), dense, upright(truth.vertices), figures)


def draw(shown: Sequence[Shown], target: Path, pixels: int = 420) -> None:
    """Draw every output below its input, lit by predicted normals."""
    side = pixels / 100
    figure = Figure(
        figsize=(len(shown) * side, 2 * side + 0.4),
        dpi=100,
        facecolor=tuple(BACKGROUND ** (1 / 2.2)),
    )
    height = 2 * side + 0.4
    for column, each in enumerate(shown):
        dense = each.dense.points.astype(np.float64) @ each.turn.T
        sparse = each.sparse.points.astype(np.float64) @ each.turn.T
        camera = Camera.on(dense, tilt=20.0, pixels=pixels)
        normals: Any = each.dense.normals
        images = (
            _splat(camera, sparse, None),
            _splat(camera, dense, normals.astype(np.float64) @ each.turn.T),
        )
        for row, image in enumerate(images):
            axes = figure.add_axes(
                (column / len(shown), (1 - row) * side / height, 1 / len(shown), side / height)
            )
            axes.imshow(image, interpolation="none")
            axes.set_axis_off()
        middle = (column + 0.5) / len(shown)
        figure.text(middle, 1 - 0.2 / height, each.name, color="#f2f4f8", size=11, ha="center")
    figure.savefig(target, facecolor=figure.get_facecolor())


def _splat(camera: Camera, points: Floats, normals: Floats | None) -> Floats:
    """Dots without normals; with them a lit surface, whose discs close the gaps."""
    gap, _ = knn(cKDTree(points), points, 2)
    radius = 0.006 * camera.extent if normals is None else 1.5 * float(np.median(gap[:, 1]))
    colors = np.broadcast_to(_CLAY, points.shape)
    return splat(camera, points, colors, radius=radius, normals=normals)
