# SPDX-License-Identifier: Apache-2.0
"""Patches: compact parts of a cloud with the neighbours that they need, inputs of the network.

The ``core`` rows of a patch come first and get charts. They are followed by rings of neighbours:
``rings`` are the numbers of leading rows that need features before each round of message passing,
and each ring holds the neighbours of the rows before it. The last rows are used as neighbours
only. A backbone can therefore slice arrays and need not search.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.geometry.frames import Frames
from pugeo_model.kernel_compiler import njit

__all__ = [
    "EDGE",
    "MESSAGES",
    "POSE",
    "SCALARS",
    "Patch",
    "edges",
    "extract_patch",
    "poses",
    "scalars",
]

MESSAGES: tuple[tuple[int, int, int], ...] = ((0, 12, 1), (1, 24, 2))
"""Neighbour columns ``(start, stop, step)`` of each round: the nearest 12, then every second of
the nearest 24, which increases the receptive field at the same cost."""

EDGE = 5
"""Features of a neighbour: x, y, z, height above the quadric, distance."""

POSE = 20
"""Features of a message: position of the sender (3), relative rotation (9), position of the
receiver as seen from the sender (3), log of the relative scale, height of the sender's quadric
above the receiver, slope of that quadric there (2), height of the sender above the receiver's
quadric."""

SCALARS = 9
"""Features of a point: quadric (6), residual, residual over noise, noise of the cloud."""

_HEIGHT_GAIN = np.float32(4.0)  # scales heights between fits, which are small beside distances
_LARGEST_DISTANCE = 8.0  # spacings; distances of isolated points are clipped to bound the inputs


@dataclass(frozen=True, eq=False)
class Patch:
    """A compact part of the cloud with its neighbours; rows are those of the patch.

    Attributes:
        rows: ``(n,)`` int32, rows in the cloud; core first, then ring by ring.
        core: number of leading rows that get a chart.
        rings: numbers of leading rows with features before round 0, 1, ... (outermost first).
        points: ``(n, 3)`` float64.
        neighbours: ``(rings[0], k)`` int32 rows of this patch.
        frames: frames of the ``rings[0]`` leading rows.
    """

    rows: NDArray[np.int32]
    core: int
    rings: tuple[int, ...]
    points: NDArray[np.float64]
    neighbours: NDArray[np.int32]
    frames: Frames


def extract_patch(
    core: NDArray[np.int32],
    points: NDArray[np.float64],
    neighbours: NDArray[np.int32],
    frames: Frames,
) -> Patch:
    """Collect the rings of neighbours around a core.

    Args:
        core: ``(n,)`` int32 rows of the cloud.
        points: ``(M, 3)`` float64, the cloud.
        neighbours: ``(M, k)`` int32, nearest first.
        frames: of all points.
    """
    count = len(points)
    local_row = np.full(count, -1, dtype=np.int32)
    rows = core
    local_row[rows] = np.arange(len(rows), dtype=np.int32)
    sizes: list[int] = [len(rows)]
    rounds: list[tuple[int, int, int] | None] = [*reversed(MESSAGES), None]
    for columns in rounds:
        start, stop, step = columns or (0, neighbours.shape[1], 1)
        ring = np.sort(_outside(rows, neighbours, start, stop, step, local_row))
        local_row[ring] = np.arange(len(rows), len(rows) + len(ring), dtype=np.int32)
        rows = np.concatenate([rows, ring])
        sizes.append(len(rows))
    framed = rows[: sizes[-2]]
    return Patch(
        rows=rows,
        core=len(core),
        rings=tuple(reversed(sizes[1:-1])),
        points=points[rows],
        neighbours=local_row[neighbours[framed]],
        frames=Frames(
            frames.axes[framed],
            frames.spacing[framed],
            frames.quadric[framed],
            frames.residual[framed],
            frames.noise,
        ),
    )


def scalars(frames: Frames) -> NDArray[np.float32]:
    """Return the features of points from the quadric fit, ``(M, SCALARS)`` float32, about 1."""
    noise = np.full_like(frames.residual, frames.noise)
    return np.concatenate(
        [
            np.clip(frames.quadric, -2.0, 2.0),
            np.clip(np.log(frames.residual + 0.01), -5.0, 2.0)[:, None] + 3.0,
            np.clip(frames.residual / (noise + 0.01), 0.0, 8.0)[:, None] - 1.0,
            np.clip(np.log(noise + 0.01), -5.0, 2.0)[:, None] + 3.0,
        ],
        axis=1,
        dtype=np.float32,
    )


def edges(patch: Patch) -> NDArray[np.float32]:
    """Return the neighbours in canonical frames, ``(k, rings[0], EDGE)`` float32, in spacings."""
    out = np.empty((*patch.neighbours.T.shape, EDGE), dtype=np.float32)
    frames = patch.frames
    _edges(patch.points, patch.neighbours, frames.axes, frames.spacing, frames.quadric, out)
    return out


def poses(patch: Patch, rows: int, columns: tuple[int, int, int]) -> NDArray[np.float32]:
    """Return the frames of neighbours relative to the frames of points.

    Args:
        patch: the patch.
        rows: number of leading rows that receive.
        columns: ``(start, stop, step)`` of the neighbours that send, see `MESSAGES`.

    Returns:
        ``(k', rows, POSE)`` float32, lengths in spacings.
    """
    senders = np.ascontiguousarray(patch.neighbours[:rows, slice(*columns)])
    out = np.empty((*senders.T.shape, POSE), dtype=np.float32)
    frames = patch.frames
    log_spacing = np.log(frames.spacing)
    _poses(patch.points, senders, frames.axes, frames.spacing, log_spacing, frames.quadric, out)
    return out


@njit(cache=True, nogil=True)
def _edges(points, neighbours, axes, spacing, quadric, out):  # type: ignore[no-untyped-def]
    """Write the features of `EDGE` into ``out``."""
    count, k = neighbours.shape
    for i in range(count):
        scale = 1.0 / spacing[i]
        f = axes[i]
        q = quadric[i]
        for j in range(k):
            other = neighbours[i, j]
            x = np.float32((points[other, 0] - points[i, 0]) * scale)
            y = np.float32((points[other, 1] - points[i, 1]) * scale)
            z = np.float32((points[other, 2] - points[i, 2]) * scale)
            distance = np.sqrt(x * x + y * y + z * z)
            if distance > _LARGEST_DISTANCE:
                x *= _LARGEST_DISTANCE / distance
                y *= _LARGEST_DISTANCE / distance
                z *= _LARGEST_DISTANCE / distance
                distance = np.float32(_LARGEST_DISTANCE)
            u = f[0, 0] * x + f[0, 1] * y + f[0, 2] * z
            v = f[1, 0] * x + f[1, 1] * y + f[1, 2] * z
            h = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            fit = (
                q[0] + q[1] * u + q[2] * v + 0.5 * q[3] * u * u + q[4] * u * v + 0.5 * q[5] * v * v
            )
            out[j, i, 0] = u
            out[j, i, 1] = v
            out[j, i, 2] = h
            out[j, i, 3] = min(max(h - fit, -_LARGEST_DISTANCE), _LARGEST_DISTANCE)
            out[j, i, 4] = distance


@njit(cache=True, nogil=True, fastmath=True)
def _height(q, u, v):  # type: ignore[no-untyped-def]
    """Height of a quadric at ``(u, v)``."""
    half = np.float32(0.5)
    return q[0] + q[1] * u + q[2] * v + half * q[3] * u * u + q[4] * u * v + half * q[5] * v * v


@njit(cache=True, nogil=True, fastmath=True)
def _poses(points, senders, axes, spacing, log_spacing, quadric, out):  # type: ignore[no-untyped-def]
    """Write the features of `POSE` into ``out``."""
    count, k = senders.shape
    most, one = np.float32(_LARGEST_DISTANCE), np.float32(1.0)
    for i in range(count):
        receiver, size, inverse_size = axes[i], spacing[i], one / spacing[i]
        for j in range(k):
            other = senders[i, j]
            sender = axes[other]
            x = np.float32(points[other, 0] - points[i, 0]) * inverse_size
            y = np.float32(points[other, 1] - points[i, 1]) * inverse_size
            z = np.float32(points[other, 2] - points[i, 2]) * inverse_size
            squared = x * x + y * y + z * z
            back = size / spacing[other]
            # Rarely true; a square root for every edge would take a tenth of the time.
            if squared * max(back * back, one) > most * most:
                clip = most / np.sqrt(squared)
                back = min(back, clip)
                if clip < one:
                    x, y, z = x * clip, y * clip, z * clip
            back = -back
            to = out[j, i]
            for a in range(3):
                to[a] = receiver[a, 0] * x + receiver[a, 1] * y + receiver[a, 2] * z
                to[12 + a] = back * (sender[a, 0] * x + sender[a, 1] * y + sender[a, 2] * z)
                for b in range(3):
                    to[3 + 3 * a + b] = (
                        receiver[a, 0] * sender[b, 0]
                        + receiver[a, 1] * sender[b, 1]
                        + receiver[a, 2] * sender[b, 2]
                    )
            log_scale = log_spacing[other] - log_spacing[i]
            to[15] = min(max(log_scale, np.float32(-3.0)), np.float32(3.0))
            # Comparison of the two fits, clipped, since a fit is invalid far from its point.
            q, u, v, cosine = quadric[other], to[12], to[13], to[11]
            rise = (_height(q, u, v) - to[14]) * cosine * min(spacing[other] * inverse_size, most)
            to[16] = _HEIGHT_GAIN * min(max(rise, -one), one)
            along, across = q[1] + q[3] * u + q[4] * v, q[2] + q[4] * u + q[5] * v
            inverse = cosine / np.sqrt(one + along * along + across * across)
            to[17] = (to[5] - along * to[3] - across * to[4]) * inverse
            to[18] = (to[8] - along * to[6] - across * to[7]) * inverse
            rise = to[2] - _height(quadric[i], to[0], to[1])
            to[19] = _HEIGHT_GAIN * min(max(rise, -one), one)


@njit(cache=True, nogil=True)
def _outside(rows, neighbours, start, stop, step, local_row):  # type: ignore[no-untyped-def]
    """Neighbours of the rows, in some columns, that are not in the patch yet, each once."""
    found = np.empty(rows.size * ((stop - start + step - 1) // step), dtype=np.int32)
    count = 0
    for row in rows:
        for column in range(start, stop, step):
            other = neighbours[row, column]
            if local_row[other] == -1:
                local_row[other] = -2
                found[count] = other
                count += 1
    return found[:count]
