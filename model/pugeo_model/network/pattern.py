# SPDX-License-Identifier: Apache-2.0
"""Even patterns of samples on a disk: where the adaptive samples (u, v) start from."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["disk", "regular_grid"]

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
_DENSE = 256  # integration points a sample in Lloyd's relaxation


@lru_cache(maxsize=128)
def disk(count: int) -> NDArray[np.float32]:
    """``count`` evenly spread samples on the disk of area 1, ``(count, 2)`` float32.

    A sunflower spiral relaxed by Lloyd's algorithm: for the handful of samples that a chart has,
    a bare spiral is visibly lopsided.
    """
    samples = _spiral(count)
    dense = _spiral(count * _DENSE)
    for _ in range(40):
        distance = ((dense[:, None, :] - samples[None]) ** 2).sum(axis=-1)
        owner = distance.argmin(axis=1)
        mass = np.maximum(np.bincount(owner, minlength=count), 1)
        for axis in range(2):
            samples[:, axis] = np.bincount(owner, dense[:, axis], count) / mass
    samples -= samples.mean(axis=0)
    return samples.astype(np.float32)


def _spiral(count: int) -> NDArray[np.float64]:
    turn = np.arange(count)
    radius = np.sqrt((turn + 0.5) / (count * np.pi))
    angle = turn * _GOLDEN_ANGLE
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
