# SPDX-License-Identifier: Apache-2.0
"""Even patterns of samples on a disk, the initial adaptive samples (u, v)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["DISK_SIDE", "disk"]

DISK_SIDE = 0.87
"""Side, in spacings, of a square with the surface area of one point of an even sample."""

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
_DENSE = 256  # integration points per sample in Lloyd's relaxation
_ROUNDS = 40
_MANY = 64  # samples from which the spiral is nearly even, and the relaxation is shorter
_FEWER_DENSE, _FEWER_ROUNDS = 32, 10


@lru_cache(maxsize=128)
def disk(count: int) -> NDArray[np.float32]:
    """Return evenly distributed samples on the disk of area 1.

    A sunflower spiral (Vogel 1979), relaxed by Lloyd's algorithm, since a spiral of few samples
    is uneven.

    Args:
        count: number of samples.

    Returns:
        ``(count, 2)`` float32, with mean 0.
    """
    samples = _spiral(count)
    many = count > _MANY
    dense = _spiral(count * (_FEWER_DENSE if many else _DENSE))
    for _ in range(_FEWER_ROUNDS if many else _ROUNDS):
        if many:
            # All pairs would cost the square of the number of samples.
            nearest = cKDTree(samples).query(dense)[1]
        else:
            nearest = ((dense[:, None, :] - samples[None]) ** 2).sum(axis=-1).argmin(axis=1)
        mass = np.maximum(np.bincount(nearest, minlength=count), 1)
        for axis in range(2):
            samples[:, axis] = np.bincount(nearest, dense[:, axis], count) / mass
    samples -= samples.mean(axis=0)
    return samples.astype(np.float32)


def _spiral(count: int) -> NDArray[np.float64]:
    """Sunflower spiral on the disk of area 1, ``(count, 2)``."""
    index = np.arange(count)
    radius = np.sqrt((index + 0.5) / (count * np.pi))
    angle = index * _GOLDEN_ANGLE
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def regular_grid(count: int) -> NDArray[np.float32]:
    """``count`` cell centres of a regular grid on a rectangle of area 1, ``(count, 2)`` float32.

    As nearly square as the divisors of ``count`` allow: 4 = 2 x 2, 8 = 2 x 4, 12 = 3 x 4. Cells are
    square.
    """
    rows = max(n for n in range(1, int(count**0.5) + 1) if count % n == 0)
    v, u = np.mgrid[:rows, : count // rows].reshape(2, -1)
    centred = np.stack([u - u.mean(), v - v.mean()], axis=1)
    grid: NDArray[np.float32] = (centred / count**0.5).astype(np.float32)
    return grid
