# SPDX-License-Identifier: Apache-2.0
"""Patches: spatial chunks with the neighbours they need, the unit of work.

Rows of a patch are sorted by what is asked of them: ``core`` rows get charts; ``rings`` say how
many leading rows must have features before each round of message passing (each ring holds the
neighbours of the one inside it); the last rows are only ever looked at as neighbours. A backbone
therefore slices and never searches.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.geometry.frames import Frames

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
"""Neighbour columns ``(start, stop, step)`` of each round: the nearest 12, then 12 of the first 24
spread wider, which doubles the reach at the same cost."""

EDGE = 5
"""Numbers on an edge of the neighbourhood: x, y, z, height above the quadric, distance."""

POSE = 20
"""Numbers on a message: position, relative rotation (9), position seen back, log scale; how far
above the receiver the sender's quadric passes, its normal there (2), the sender above the
receiver's."""

SCALARS = 9
"""Numbers on a point: quadric (6), residual, residual over noise, noise of the cloud."""

_GAIN = np.float32(4.0)  # heights between fits are small beside distances
_FAR = 8.0  # spacings; an isolated point's neighbours must not blow up the network's inputs


@dataclass(frozen=True, eq=False)
class Patch:
    """A chunk of the cloud, rows local.

    Attributes:
        rows: ``(n,)`` int32, rows in the cloud; core first, then ring by ring.
        core: number of leading rows that get a chart.
        rings: leading rows with features before round 0, 1, ... (outermost first).
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
    """The patch around ``core`` (rows of the cloud) with its rings of neighbours."""
    count = len(points)
    place = np.full(count, -1, dtype=np.int32)
    rows = core
    place[rows] = np.arange(len(rows), dtype=np.int32)
    sizes: list[int] = [len(rows)]
    reaches: list[tuple[int, int, int] | None] = [*reversed(MESSAGES), None]
    for reach in reaches:
        start, stop, step = reach or (0, neighbours.shape[1], 1)
        fresh = np.sort(_outside(rows, neighbours, start, stop, step, place))
        place[fresh] = np.arange(len(rows), len(rows) + len(fresh), dtype=np.int32)
        rows = np.concatenate([rows, fresh])
        sizes.append(len(rows))
    framed = rows[: sizes[-2]]
    return Patch(
        rows=rows,
        core=len(core),
        rings=tuple(reversed(sizes[1:-1])),
        points=points[rows],
        neighbours=place[neighbours[framed]],
        frames=Frames(
            frames.axes[framed],
            frames.spacing[framed],
            frames.quadric[framed],
            frames.residual[framed],
            frames.noise,
        ),
    )


def scalars(frames: Frames) -> NDArray[np.float32]:
    """What the fit knows of each point, ``(M, SCALARS)`` float32, all about unit size."""
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
    """Every neighbour in its point's frame, ``(k, rings[0], EDGE)`` float32, in spacings."""
    out = np.empty((*patch.neighbours.T.shape, EDGE), dtype=np.float32)
    frames = patch.frames
    _edges(patch.points, patch.neighbours, frames.axes, frames.spacing, frames.quadric, out)
    return out


def poses(patch: Patch, rows: int, reach: tuple[int, int, int]) -> NDArray[np.float32]:
    """Where each neighbour's frame lies in its point's frame, ``(k', rows, POSE)`` float32."""
    columns = np.ascontiguousarray(patch.neighbours[:rows, slice(*reach)])
    out = np.empty((*columns.T.shape, POSE), dtype=np.float32)
    frames = patch.frames
    scale = np.log(frames.spacing)
    _poses(patch.points, columns, frames.axes, frames.spacing, scale, frames.quadric, out)
    return out


@njit(cache=True, nogil=True)
def _edges(points, neighbours, axes, spacing, quadric, out):  # type: ignore[no-untyped-def]
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
            far = np.sqrt(x * x + y * y + z * z)
            if far > _FAR:
                x *= _FAR / far
                y *= _FAR / far
                z *= _FAR / far
                far = np.float32(_FAR)
            u = f[0, 0] * x + f[0, 1] * y + f[0, 2] * z
            v = f[1, 0] * x + f[1, 1] * y + f[1, 2] * z
            h = f[2, 0] * x + f[2, 1] * y + f[2, 2] * z
            fit = (
                q[0] + q[1] * u + q[2] * v + 0.5 * q[3] * u * u + q[4] * u * v + 0.5 * q[5] * v * v
            )
            out[j, i, 0] = u
            out[j, i, 1] = v
            out[j, i, 2] = h
            out[j, i, 3] = min(max(h - fit, -_FAR), _FAR)
            out[j, i, 4] = far


@njit(cache=True, nogil=True, fastmath=True)
def _height(q, u, v):  # type: ignore[no-untyped-def]
    half = np.float32(0.5)
    return q[0] + q[1] * u + q[2] * v + half * q[3] * u * u + q[4] * u * v + half * q[5] * v * v


@njit(cache=True, nogil=True, fastmath=True)
def _poses(points, columns, axes, spacing, scale, quadric, out):  # type: ignore[no-untyped-def]
    count, k = columns.shape
    most, one = np.float32(_FAR), np.float32(1.0)
    for i in range(count):
        mine, size, scaled = axes[i], spacing[i], one / spacing[i]
        for j in range(k):
            other = columns[i, j]
            theirs = axes[other]
            x = np.float32(points[other, 0] - points[i, 0]) * scaled
            y = np.float32(points[other, 1] - points[i, 1]) * scaled
            z = np.float32(points[other, 2] - points[i, 2]) * scaled
            squared = x * x + y * y + z * z
            back = size / spacing[other]
            # Hardly ever: a root for every edge would be a tenth of the time.
            if squared * max(back * back, one) > most * most:
                clip = most / np.sqrt(squared)
                back = min(back, clip)
                if clip < one:
                    x, y, z = x * clip, y * clip, z * clip
            back = -back
            to = out[j, i]
            for a in range(3):
                to[a] = mine[a, 0] * x + mine[a, 1] * y + mine[a, 2] * z
                to[12 + a] = back * (theirs[a, 0] * x + theirs[a, 1] * y + theirs[a, 2] * z)
                for b in range(3):
                    to[3 + 3 * a + b] = (
                        mine[a, 0] * theirs[b, 0]
                        + mine[a, 1] * theirs[b, 1]
                        + mine[a, 2] * theirs[b, 2]
                    )
            to[15] = min(max(scale[other] - scale[i], np.float32(-3.0)), np.float32(3.0))
            # What fits say of each other, clipped: far from where it was made a fit says nothing.
            q, u, v, cosine = quadric[other], to[12], to[13], to[11]
            rise = (_height(q, u, v) - to[14]) * cosine * min(spacing[other] * scaled, most)
            to[16] = _GAIN * min(max(rise, -one), one)
            along, across = q[1] + q[3] * u + q[4] * v, q[2] + q[4] * u + q[5] * v
            inverse = cosine / np.sqrt(one + along * along + across * across)
            to[17] = (to[5] - along * to[3] - across * to[4]) * inverse
            to[18] = (to[8] - along * to[6] - across * to[7]) * inverse
            rise = to[2] - _height(quadric[i], to[0], to[1])
            to[19] = _GAIN * min(max(rise, -one), one)


@njit(cache=True, nogil=True)
def _outside(rows, neighbours, start, stop, step, place):  # type: ignore[no-untyped-def]
    """Neighbours of the rows, in some columns, that have no place yet, each once."""
    found = np.empty(rows.size * ((stop - start + step - 1) // step), dtype=np.int32)
    count = 0
    for row in rows:
        for column in range(start, stop, step):
            other = neighbours[row, column]
            if place[other] == -1:
                place[other] = -2
                found[count] = other
                count += 1
    return found[:count]
