# SPDX-License-Identifier: Apache-2.0
"""What the figures look like: error, normals and reconstructed surface of a dense cloud as PNG.

Drawn without a display. Error has one scale for all pictures, so that any two can be compared.
"""

from pathlib import Path

import igl
import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model.geometry.neighbours import knn
from pugeo_model.metrics.evaluation import Measured
from pugeo_model.metrics.reconstruction import Mesh
from pugeo_model.render import BACKGROUND, Camera, splat
from pugeo_model.training.corpus import uniform

__all__ = ["FAR", "draw", "upright"]

FAR = 2e-3
"""Distance to the true surface at the end of the colour bar, of the longest side."""

Floats = NDArray[np.float64]

_TILT = 20.0  # degrees, looking down
_CLAY = np.array([0.62, 0.60, 0.56])
_COLORS = colormaps["turbo"]
_DISCS = 100_000  # for a surface
_INK, _BLUR = "#f2f4f8", "#9aa4b5"


def draw(measured: Measured, target: Path, pixels: int = 520) -> None:
    """Draw one dense cloud: coloured by error, lit by its normals, and its surface if there is one.

    Args:
        measured: a cloud with normals, and what was measured of it.
        target: a ``.png`` file.
        pixels: side of every panel.
    """
    dense = measured.dense
    assert dense.normals is not None
    points, normals = dense.points.astype(np.float64), dense.normals.astype(np.float64)
    distance, _, _ = measured.truth.distance.nearest(points)
    turn = upright(measured.truth.vertices)
    camera = Camera.on(measured.truth.vertices @ turn.T, tilt=_TILT, pixels=pixels)
    row = measured.row
    clay = np.broadcast_to(_CLAY, points.shape)
    points, normals = points @ turn.T, normals @ turn.T
    panels = [
        (
            _draw_cloud(camera, points, normals, _error_colors(distance), lit=False),
            "distance to the surface",
            f"mean {row['P2F']:.2f}, largest {1e3 * distance.max():.1f}  ×10⁻³",
        ),
        (
            _draw_cloud(camera, points, normals, clay, lit=True),
            "lit by its normals",
            f"{len(points):,} points, {row['normal_mean']:.1f}° off in the mean",
        ),
    ]
    if measured.surface is not None:
        panels.append(
            (
                _draw_mesh(camera, turn, measured.surface),
                "reconstructed from both",
                f"CD# {row['CD#']:.3f}, HD# {row['HD#']:.2f}  ×10⁻²",
            )
        )
    _write(panels, f"{measured.truth.name}, {measured.case.name}", target)


def upright(vertices: Floats) -> Floats:
    """``(3, 3)`` rotation of meshes that have no common up: y or z up, never x; broad side ahead.

    Models that stand, stand on y or z; of the two the longer is taken for the height.
    """
    size = np.ptp(vertices, axis=0)
    up = 1 if size[1] >= size[2] else 2
    depth = min((axis for axis in range(3) if axis != up), key=lambda axis: (size[axis], -axis))
    upward, towards = np.eye(3)[up], np.eye(3)[depth]
    return np.stack([np.cross(upward, towards), upward, towards])


def _error_colors(distance: Floats) -> Floats:
    """Linear RGB ``(K, 3)`` of the colour bar."""
    return np.asarray(_COLORS(distance / FAR)[:, :3] ** 2.2)


def _draw_mesh(camera: Camera, turn: Floats, mesh: Mesh) -> Floats:
    """A mesh as a cloud of so many discs that no gap is left."""
    vertices, faces = mesh
    points = uniform(vertices, faces, _DISCS, np.random.default_rng(0))
    _, nearest = knn(cKDTree(vertices), points, 1)
    normals = igl.per_vertex_normals(vertices, faces)[nearest[:, 0]]
    area = float(igl.doublearea(vertices, faces).sum()) / 2
    clay = np.broadcast_to(_CLAY, points.shape)
    radius = 2.0 * np.sqrt(area / _DISCS)  # one point in 300,000 of the surface stays bare
    return splat(camera, points @ turn.T, clay, radius=radius, normals=normals @ turn.T)


def _draw_cloud(
    camera: Camera, points: Floats, normals: Floats, colors: Floats, *, lit: bool
) -> Floats:
    gap, _ = knn(cKDTree(points), points, 2)
    radius = 1.5 * float(np.median(gap[:, 1]))
    return splat(camera, points, colors, radius=radius, normals=normals, lit=lit)


def _write(panels: list[tuple[Floats, str, str]], title: str, target: Path) -> None:
    side, top, foot = panels[0][0].shape[0] / 100, 0.5, 1.45
    share, height = 1 / len(panels), top + side + foot
    background = tuple(BACKGROUND ** (1 / 2.2))
    figure = Figure(figsize=(len(panels) * side, height), dpi=100, facecolor=background)
    figure.text(0.02, 1 - 0.3 / height, title, color=_INK, size=17, va="center", weight="bold")
    for index, (image, name, caption) in enumerate(panels):
        axes = figure.add_axes((index * share, foot / height, share, side / height))
        axes.imshow(image, interpolation="none")
        axes.set_axis_off()
        middle = (index + 0.5) * share
        figure.text(middle, 1.12 / height, name, color=_INK, size=15, ha="center")
        figure.text(middle, 0.82 / height, caption, color=_BLUR, size=12, ha="center")
    place = figure.add_axes((0.2 * share, 0.52 / height, 0.6 * share, 0.12 / height))
    scale = ScalarMappable(Normalize(0.0, 1e3 * FAR), _COLORS)
    bar = figure.colorbar(scale, cax=place, orientation="horizontal", extend="max")
    bar.ax.tick_params(colors=_BLUR, labelsize=10)
    bar.set_label("×10⁻³ of the longest side", color=_BLUR, size=10)
    figure.savefig(target, facecolor=background)
