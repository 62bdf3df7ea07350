# SPDX-License-Identifier: Apache-2.0
"""Even patterns of samples on a disk: where the adaptive samples (u, v) start from."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["disk"]

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
