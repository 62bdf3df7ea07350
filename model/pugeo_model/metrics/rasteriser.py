# SPDX-License-Identifier: Apache-2.0
"""Rasterisation of point clouds as discs (surface splatting, Zwicker et al. 2001), on the CPU.

Each point is a disc. Discs are divided into pixels, the nearest fragment of each pixel is found,
and all fragments just behind it are blended with it, so that a dense cloud with normals looks like
a surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["BACKGROUND", "Camera", "splat"]

Floats = NDArray[np.float64]

SUPERSAMPLING = 2
BACKGROUND = np.array([0.012, 0.015, 0.021])
KEY_LIGHT = np.array([-0.45, 0.65, 0.62])  # from above left, towards the viewer
FILL_LIGHT = np.array([0.75, -0.1, 0.45])
VIEWER = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """An orthographic camera.

    Attributes:
        centre: ``(3,)``, centre of the picture, cloud units.
        extent: distance from the centre to the edge of the picture, cloud units.
        turn: rotation turn_matrix the vertical axis y, degrees.
        tilt: rotation turn_matrix the horizontal axis, degrees; positive looks down.
        pixels: side of the square picture.
    """

    centre: Floats
    extent: float
    turn: float = 15.0
    tilt: float = -25.0
    pixels: int = 700

    @classmethod
    def on(cls, points: Floats, **changes: float) -> "Camera":
        """Create a camera whose picture contains a whole cloud ``(M, 3)``, with a small margin."""
        upright = cls(np.zeros(3), 1.0, **changes)  # type: ignore[arg-type]
        seen = points @ upright.rotation().T
        middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
        extent = 1.08 * float(np.abs(seen - middle)[:, :2].max())
        return cls(middle @ upright.rotation(), extent, **changes)  # type: ignore[arg-type]

    def rotation(self) -> Floats:
        """Return the rotation ``(3, 3)``; its rows are right, up, and towards the viewer."""
        turn, tilt = np.radians(self.turn), np.radians(self.tilt)
        turn_matrix = np.array(
            [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
        )
        tilt_matrix = np.array(
            [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
        )
        return np.asarray(tilt_matrix @ turn_matrix)


def splat(
    camera: Camera,
    points: Floats,
    colors: Floats,
    *,
    radius: float,
    normals: Floats | None = None,
    lit: bool = True,
) -> Floats:
    """Draw a cloud: with normals as a shaded surface, without normals as dots.

    Behind each dot lies a larger disc in the colour of the background, so that the far side of an
    object is not visible between the dots of the near side.

    Args:
        camera: the camera.
        points: ``(M, 3)``, cloud units.
        colors: ``(M, 3)``, linear RGB in [0, 1].
        radius: radius of each disc, cloud units; discs behind dots are three times as large.
        normals: ``(M, 3)`` unit length, of any sign, or ``None``.
        lit: shade surfaces; otherwise colours match those of a colour bar.

    Returns:
        ``(pixels, pixels, 3)`` RGB in [0, 1], gamma corrected.
    """
    side = camera.pixels * SUPERSAMPLING
    rotation = camera.rotation()
    seen = (points - camera.centre) @ rotation.T
    scale = side / (2 * camera.extent)
    if normals is None:
        facing = np.broadcast_to(VIEWER, points.shape)
        dots = _fragments(seen, facing, radius, scale, side)
        backs = _fragments(seen - 7 * radius * VIEWER, facing, 3 * radius, scale, side)
        backs = (*backs[:3], backs[3] + len(points))
        fragments = tuple(np.concatenate(pair) for pair in zip(dots, backs, strict=True))
        shaded = np.vstack([colors * _fog(seen[:, 2:]), np.broadcast_to(BACKGROUND, colors.shape)])
    else:
        facing = normals @ rotation.T
        facing = np.where(facing[:, 2:] < 0, -facing, facing)
        fragments = _fragments(seen, facing, radius, scale, side)
        shaded = _light(colors, facing) if lit else colors
    pixel, depth, weight, owner = fragments
    nearest = np.full(side * side, -np.inf)
    np.maximum.at(nearest, pixel, depth)
    # Fragments up to one radius behind the nearest one belong to the same surface.
    same = depth >= nearest[pixel] - radius
    pixel, weight, owner = pixel[same], weight[same], owner[same]
    total = np.bincount(pixel, weight, side * side)
    channels = [np.bincount(pixel, weight * shaded[owner, c], side * side) for c in range(3)]
    covered = total > 0
    image = np.broadcast_to(BACKGROUND, (side * side, 3)).copy()
    image[covered] = np.stack(channels, axis=1)[covered] / total[covered, None]
    image = image.reshape(side, side, 3)
    if normals is not None and lit:
        image *= np.where(covered, _ambient_occlusion(nearest, side, camera.extent), 1).reshape(
            side, side, 1
        )
    small = image.reshape(camera.pixels, SUPERSAMPLING, camera.pixels, SUPERSAMPLING, 3)
    return np.asarray(np.clip(small.mean(axis=(1, 3)), 0, 1) ** (1 / 2.2))


def _light(colors: Floats, facing: Floats) -> Floats:
    """Shade colours with two diffuse lights and a highlight (Blinn-Phong)."""
    key = np.clip(facing @ _unit(KEY_LIGHT), 0, 1)[:, None]
    fill = np.clip(facing @ _unit(FILL_LIGHT), 0, 1)[:, None]
    highlight = np.clip(facing @ _unit(KEY_LIGHT + VIEWER), 0, 1)[:, None] ** 40
    return np.asarray(colors * (0.16 + 0.95 * key + 0.22 * fill) + 0.22 * highlight)


def _fog(depth: Floats) -> Floats:
    """Brightness by depth: without normals, points further away are drawn darker."""
    span = np.ptp(depth) or 1.0
    return np.asarray(0.25 + 0.75 * (depth - depth.min()) / span)


def _fragments(
    seen: Floats, facing: Floats, radius: float, scale: float, side: int
) -> tuple[NDArray[np.intp], Floats, Floats, NDArray[np.intp]]:
    """Divide discs into pixels: flat pixel index, depth, weight and point of each fragment."""
    extent = max(1, int(np.ceil(radius * scale)))
    offsets = np.stack(np.meshgrid(*[np.arange(-extent, extent + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) <= extent + 0.5]
    place = seen[:, :2] * scale * [1, -1] + side / 2
    corner = np.floor(place)
    # Bounded, since a disc seen edge-on is infinitely thin and steep.
    steep = np.maximum(facing[:, 2], 0.15)
    parts = []
    for offset in offsets:
        at = corner + offset
        dx, dy = ((at + 0.5 - place) / scale).T * [[1], [-1]]
        rise = -(facing[:, 0] * dx + facing[:, 1] * dy) / steep
        within = (dx**2 + dy**2 + rise**2) / radius**2
        inside = (within < 1) & np.all((at >= 0) & (at < side), axis=1)
        pixel = (at[inside, 1] * side + at[inside, 0]).astype(np.intp)
        depth = seen[inside, 2] + rise[inside]
        parts.append((pixel, depth, (1 - within[inside]) ** 2 + 1e-6, np.flatnonzero(inside)))
    pixels, depths, weights, owners = (np.concatenate(part) for part in zip(*parts, strict=True))
    return pixels, depths, weights, owners


def _ambient_occlusion(nearest: Floats, side: int, extent: float) -> Floats:
    """Ambient light of each pixel: less where its surroundings are nearer to the viewer."""
    depth = nearest.reshape(side, side)
    covered = np.isfinite(depth)
    shade = np.ones_like(depth)
    for blur in (0.006, 0.02, 0.05):
        sigma = blur * side
        weight = ndimage.gaussian_filter(covered.astype(np.float64), sigma, truncate=2.5)
        around = ndimage.gaussian_filter(np.where(covered, depth, 0), sigma, truncate=2.5)
        mean = around / np.maximum(weight, 1e-9)
        hidden = np.where(covered, mean - depth, 0) / (6 * blur * extent)
        shade *= 1 - 0.45 * np.clip(hidden, 0, 1)
    return shade.ravel()


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))
