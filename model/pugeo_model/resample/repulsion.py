# SPDX-License-Identifier: Apache-2.0
"""Tangential repulsion: survivors of the elimination settle into even spacing."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pugeo_model.tuning import TUNING

__all__ = ["repel"]

_STEP = TUNING.repulsion_step
_RANGE = TUNING.repulsion_range
_PUSH = 0.7  # of the push of those at common distances
_SQUEEZED = 0.06  # over the square of the distance in ranges: neighbours would hold a pair together
_HARDEST = 10.0  # of samples that share a spot, as it were
_LIMIT = 0.25  # of the radius: the furthest move in one round
_TINY = 1e-300  # squared distance of samples in one place, which do not push


def repel(
    samples: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    radius: NDArray[np.float64],
    rounds: int,
) -> NDArray[np.float64]:
    """Move samples apart within their tangent planes.

    The push rises steeply where two are much too close: else the neighbours of a pair, which push
    from all sides, hold it together.

    Samples across a crease push like all others: without them those along it were pushed over it,
    and came down among those of the other side.

    Args:
        samples: ``(K, 3)``.
        normals: ``(K, 3)`` unit.
        neighbours: ``(K, k)`` rows, ``-1`` where there is none.
        radius: ``(K,)`` distance of neighbours in the packing aimed at.
        rounds: how often.
    """
    now, after = samples.copy(), np.empty_like(samples)
    for _ in range(rounds):
        _push(now, normals, neighbours, radius, after)
        now, after = after, now
    return now


@njit(cache=True, nogil=True, fastmath=True)
def _push(samples, normals, neighbours, radius, after):  # type: ignore[no-untyped-def]
    for i in range(len(samples)):
        here = samples[i, 0], samples[i, 1], samples[i, 2]
        after[i, 0], after[i, 1], after[i, 2] = here
        if radius[i] == 0.0:
            continue
        inverse = 1.0 / (_RANGE * radius[i])
        squeezed = _SQUEEZED / (inverse * inverse)
        a = b = c = 0.0
        for at in range(neighbours.shape[1]):
            j = neighbours[i, at]
            if j < 0:
                break
            x = here[0] - samples[j, 0]
            y = here[1] - samples[j, 1]
            z = here[2] - samples[j, 2]
            squared = max(x * x + y * y + z * z, _TINY)
            per = 1.0 / np.sqrt(squared)
            # No branch: which of them are beyond the range is not to be guessed.
            w = max(1.0 - squared * per * inverse, 0.0)
            w *= w * per * min(_PUSH + squeezed * per * per, _HARDEST)
            a += w * x
            b += w * y
            c += w * z
        n = normals[i, 0], normals[i, 1], normals[i, 2]
        along = a * n[0] + b * n[1] + c * n[2]
        step = _STEP * radius[i]
        a = (a - along * n[0]) * step
        b = (b - along * n[1]) * step
        c = (c - along * n[2]) * step
        size = np.sqrt(a * a + b * b + c * c)
        limit = _LIMIT * radius[i]
        shrink = limit / size if size > limit else 1.0
        after[i, 0] += shrink * a
        after[i, 1] += shrink * b
        after[i, 2] += shrink * c
