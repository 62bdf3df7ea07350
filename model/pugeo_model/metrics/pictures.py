# SPDX-License-Identifier: Apache-2.0
"""Pictures of a dense cloud as PNG: error, normals and reconstructed surface.

No display is needed. All pictures have the same scale of errors, so that they can be compared.
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
from pugeo_model.mesh.sampling import uniform
from pugeo_model.metrics.evaluation import Measured
from pugeo_model.metrics.rasteriser import BACKGROUND, Camera, splat
from pugeo_model.metrics.reconstruction import Mesh

__all__ = ["LARGEST_ERROR", "draw", "upright"]

LARGEST_ERROR = 2e-3
"""Distance to the true surface at the end of the colour bar, of the longest side."""

Floats = NDArray[np.float64]

_TILT = 20.0  # degrees, positive looks down
_SURFACE_COLOR = np.array([0.62, 0.60, 0.56])  # linear RGB
_COLORS = colormaps["turbo"]
_DISCS = 100_000  # discs that a surface is drawn with
_TITLE_COLOR, _CAPTION_COLOR = "#f2f4f8", "#9aa4b5"


def draw(measured: Measured, target: Path, pixels: int = 520) -> None:
    """Draw a dense cloud coloured by error, shaded by its normals, and its surface if present.

    Args:
        measured: the evaluation of a cloud with normals.
        target: a ``.png`` file.
        pixels: side of each panel.
    """
    dense = measured.dense
    assert dense.normals is not None
    points, normals = dense.points.astype(np.float64), dense.normals.astype(np.float64)
    distance, _, _ = measured.truth.distance.nearest(points)
    rotation = upright(measured.truth.vertices)
    camera = Camera.on(measured.truth.vertices @ rotation.T, tilt=_TILT, pixels=pixels)
    row = measured.row
    gray = np.broadcast_to(_SURFACE_COLOR, points.shape)
    points, normals = points @ rotation.T, normals @ rotation.T
    panels = [
        (
            _draw_cloud(camera, points, normals, _error_colors(distance), lit=False),
            "distance to the surface",
            f"mean {row['P2F']:.2f}, largest {1e3 * distance.max():.1f}  ×10⁻³",
        ),
        (
            _draw_cloud(camera, points, normals, gray, lit=True),
            "shaded by its normals",
            f"{len(points):,} points, mean error of normals {row['normal_mean']:.1f}°",
        ),
    ]
    if measured.surface is not None:
        panels.append(
            (
                _draw_mesh(camera, rotation, measured.surface),
                "reconstructed surface",
                f"CD# {row['CD#']:.3f}, HD# {row['HD#']:.2f}  ×10⁻²",
            )
        )
    _write(panels, f"{measured.truth.name}, {measured.case.name}", target)


def upright(vertices: Floats) -> Floats:
    """Rotation ``(3, 3)`` for a mesh of unknown orientation: y or z up, broad side to the viewer.

    The longer of y and z is taken for the height.
    """
    size = np.ptp(vertices, axis=0)
    up = 1 if size[1] >= size[2] else 2
    depth = min((axis for axis in range(3) if axis != up), key=lambda axis: (size[axis], -axis))
    upward, towards = np.eye(3)[up], np.eye(3)[depth]
    return np.stack([np.cross(upward, towards), upward, towards])


def _error_colors(distance: Floats) -> Floats:
    """Linear RGB ``(K, 3)`` of distances ``(K,)`` by the colour bar."""
    return np.asarray(_COLORS(distance / LARGEST_ERROR)[:, :3] ** 2.2)


def _draw_mesh(camera: Camera, rotation: Floats, mesh: Mesh) -> Floats:
    """Draw a mesh as a cloud of discs without gaps."""
    vertices, faces = mesh
    points = uniform(vertices, faces, _DISCS, np.random.default_rng(0))
    _, nearest = knn(cKDTree(vertices), points, 1)
    normals = igl.per_vertex_normals(vertices, faces)[nearest[:, 0]]
    area = float(igl.doublearea(vertices, faces).sum()) / 2
    gray = np.broadcast_to(_SURFACE_COLOR, points.shape)
    radius = 2.0 * np.sqrt(area / _DISCS)  # leaves 1/300,000 of the surface uncovered
    return splat(camera, points @ rotation.T, gray, radius=radius, normals=normals @ rotation.T)


def _draw_cloud(
    camera: Camera, points: Floats, normals: Floats, colors: Floats, *, lit: bool
) -> Floats:
    """Draw a cloud with discs of 1.5 times the median distance to the nearest neighbour."""
    distance, _ = knn(cKDTree(points), points, 2)
    radius = 1.5 * float(np.median(distance[:, 1]))
    return splat(camera, points, colors, radius=radius, normals=normals, lit=lit)


def _write(panels: list[tuple[Floats, str, str]], title: str, target: Path) -> None:
    """Compose panels (image, name, caption), a title and a colour bar into a PNG."""
    side, top, foot = panels[0][0].shape[0] / 100, 0.5, 1.45
    width, height = 1 / len(panels), top + side + foot
    background = tuple(BACKGROUND ** (1 / 2.2))
    figure = Figure(figsize=(len(panels) * side, height), dpi=100, facecolor=background)
    figure.text(
        0.02, 1 - 0.3 / height, title, color=_TITLE_COLOR, size=17, va="center", weight="bold"
    )
    for index, (image, name, caption) in enumerate(panels):
        axes = figure.add_axes((index * width, foot / height, width, side / height))
        axes.imshow(image, interpolation="none")
        axes.set_axis_off()
        middle = (index + 0.5) * width
        figure.text(middle, 1.12 / height, name, color=_TITLE_COLOR, size=15, ha="center")
        figure.text(middle, 0.82 / height, caption, color=_CAPTION_COLOR, size=12, ha="center")
    bar_axes = figure.add_axes((0.2 * width, 0.52 / height, 0.6 * width, 0.12 / height))
    scale = ScalarMappable(Normalize(0.0, 1e3 * LARGEST_ERROR), _COLORS)
    bar = figure.colorbar(scale, cax=bar_axes, orientation="horizontal", extend="max")
    bar.ax.tick_params(colors=_CAPTION_COLOR, labelsize=10)
    bar.set_label("×10⁻³ of the longest side", color=_CAPTION_COLOR, size=10)
    figure.savefig(target, facecolor=background)
