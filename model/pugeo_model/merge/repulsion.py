# SPDX-License-Identifier: Apache-2.0
"""Tangential repulsion: survivors of the elimination settle into even spacing."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["repel"]

_STEP = 0.5  # of the mean push: the study's value
_RANGE = 1.3  # reaches within which samples push
_LIMIT = 0.25  # of the reach: the furthest move in one round


def repel(
    samples: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    reach: NDArray[np.float64],
    rounds: int,
) -> NDArray[np.float64]:
    """Move samples apart within their tangent planes.

    Args:
        samples: ``(K, 3)``.
        normals: ``(K, 3)`` unit.
        neighbours: ``(K, k)`` rows, ``-1`` where there is none.
        reach: ``(K,)`` distance of neighbours in the packing aimed at.
        rounds: how often.
    """
    now = samples.copy()
    for _ in range(rounds):
        after = now.copy()
        _push(now, normals, neighbours, reach, after)
        now = after
    return now


@njit(cache=True, nogil=True)
def _push(samples, normals, neighbours, reach, after):  # type: ignore[no-untyped-def]
    push = np.zeros(3)
    for i in range(len(samples)):
        push[:] = 0.0
        far = _RANGE * reach[i]
        total = 0.0
        for at in range(neighbours.shape[1]):
            j = neighbours[i, at]
            if j < 0:
                break
            x = samples[i, 0] - samples[j, 0]
            y = samples[i, 1] - samples[j, 1]
            z = samples[i, 2] - samples[j, 2]
            d = np.sqrt(x * x + y * y + z * z)
            if d >= far or d == 0.0:
                continue
            # Both sides of a thin wall are near each other, but not neighbours on the surface.
            if (
                normals[i, 0] * normals[j, 0]
                + normals[i, 1] * normals[j, 1]
                + normals[i, 2] * normals[j, 2]
            ) ** 2 < 0.25:
                continue
            w = 1.0 - d / far
            w *= w
            total += w
            push[0] += w * x / d
            push[1] += w * y / d
            push[2] += w * z / d
        if total == 0.0:
            continue
        along = push[0] * normals[i, 0] + push[1] * normals[i, 1] + push[2] * normals[i, 2]
        size = 0.0
        for a in range(3):
            push[a] = (push[a] - along * normals[i, a]) * _STEP * reach[i]
            size += push[a] * push[a]
        size = np.sqrt(size)
        limit = _LIMIT * reach[i]
        shrink = limit / size if size > limit else 1.0
        for a in range(3):
            after[i, a] = samples[i, a] + shrink * push[a]
