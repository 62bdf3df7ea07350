# SPDX-License-Identifier: Apache-2.0
"""Small picture of a cloud as HTML, for notebooks: orthographic splats into a PNG."""

import base64
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["picture"]

SIZE = 320  # pixels, width and height
MAX_POINTS = 200_000
MAX_SQUARE = 6  # pixels
_GREY = np.array([205.0, 205.0, 215.0])
# Rows: right, up and towards the viewer, for a look from the front, the right and above.
_VIEW = np.array([[0.8, 0.6, 0.0], [-0.3, 0.4, 0.866], [0.52, -0.693, 0.5]])
_AMBIENT = 0.35


def picture(
    points: NDArray[Any],
    normals: NDArray[np.float32] | None,
    colors: NDArray[np.uint8] | None,
    *,
    caption: str,
) -> str:
    """Draw a cloud.

    Args:
        points: ``(M, 3)``, any units; z is up.
        normals: ``(M, 3)`` for shading, or None.
        colors: ``(M, 3)`` or ``(M, 4)`` uint8, or None for grey.
        caption: HTML below the picture.

    Returns:
        HTML with the PNG inside, some tens of kilobytes.
    """
    step = max(1, -(-len(points) // MAX_POINTS))
    chosen = np.flatnonzero(np.isfinite(points[::step]).all(axis=1)) * step
    image = np.full((SIZE, SIZE, 3), 255, dtype=np.uint8)
    if len(chosen):
        shades = _shades(chosen, normals, colors)
        _splat(image, np.asarray(points[chosen], dtype=np.float64), shades)
    encoded = base64.b64encode(_png(image)).decode("ascii")
    return (
        f'<figure><img alt="point cloud" width="{SIZE}" height="{SIZE}" '
        f'src="data:image/png;base64,{encoded}"><figcaption>{caption}</figcaption></figure>'
    )


def _shades(
    chosen: NDArray[np.intp],
    normals: NDArray[np.float32] | None,
    colors: NDArray[np.uint8] | None,
) -> NDArray[np.uint8]:
    """Return ``(K, 3)`` colours, darker where the normal turns away from the viewer."""
    base = np.tile(_GREY, (len(chosen), 1)) if colors is None else colors[chosen, :3]
    if normals is None:
        return base.astype(np.uint8)
    facing = np.nan_to_num(np.abs(normals[chosen] @ _VIEW[2]))
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(facing, 0, 1)
    return np.asarray(base * light[:, None]).astype(np.uint8)


def _splat(
    image: NDArray[np.uint8], points: NDArray[np.float64], shades: NDArray[np.uint8]
) -> None:
    """Draw each point as a small square; nearer points cover those behind."""
    # Halves before the difference: coordinates near the largest double must not overflow.
    low, high = points.min(axis=0), points.max(axis=0)
    extent = (high / 2 - low / 2).max() or 1.0
    x, y, depth = _VIEW @ ((points / 2 - (low / 4 + high / 4)) / extent).T
    order = np.argsort(depth, kind="stable")
    scale = (SIZE - 4) / 2 / max(float(np.abs(np.stack([x, y])).max()), 1e-12)
    column = (SIZE / 2 + x[order] * scale).astype(int)
    row = (SIZE / 2 - y[order] * scale).astype(int)
    # Few points are drawn larger, so that a surface looks closed.
    side = int(np.clip(2 * SIZE / np.sqrt(len(points)), 2, MAX_SQUARE))
    down, right = (offset.ravel() for offset in np.mgrid[:side, :side] - side // 2)
    rows = np.clip(row[:, None] + down, 0, SIZE - 1)
    columns = np.clip(column[:, None] + right, 0, SIZE - 1)
    # Of several values for a pixel numpy keeps the last one, the nearest.
    image[rows, columns] = shades[order, None]


def _png(image: NDArray[np.uint8]) -> bytes:
    """Encode an ``(H, W, 3)`` image (PNG specification, 8-bit RGB, no filter)."""
    height, width, _ = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes()))
        + chunk(b"IEND", b"")
    )
