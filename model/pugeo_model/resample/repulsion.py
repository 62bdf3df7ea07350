# SPDX-License-Identifier: Apache-2.0
"""Tangential repulsion: survivors of the elimination are moved to an even spacing.

A point i moves by ``step r_i P_i sum_j w(d_ij)^2 u_ij min(a + b / d_ij^2, c)``, limited in length,
where P_i projects onto its tangent plane, ``u_ij`` is the unit vector from point j, ``d_ij`` the
distance in units of the range, and ``w(d) = max(1 - d, 0)``.
"""

import numpy as np
from numpy.typing import NDArray

from pugeo_model.kernel_compiler import njit
from pugeo_model.tuning import TUNING

__all__ = ["repel"]

_STEP = TUNING.repulsion_step
_RANGE = TUNING.repulsion_range
_STRENGTH = TUNING.repulsion_strength
_CLOSE = TUNING.repulsion_close
_MOST = TUNING.repulsion_most
_LIMIT = TUNING.repulsion_limit
_TINY = 1e-300  # squared distance of coincident samples, which do not push each other


def repel(
    samples: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    radius: NDArray[np.float64],
    rounds: int,
) -> NDArray[np.float64]:
    """Move samples apart within their tangent planes.

    The push increases steeply at small distances, since otherwise the neighbours of a close pair
    keep it together. Samples across a crease push too: without them, samples along the crease
    would be pushed over it.

    Args:
        samples: ``(K, 3)`` float64.
        normals: ``(K, 3)`` float32, unit length.
        neighbours: ``(K, k)`` int32 rows, then ``-1``.
        radius: ``(K,)`` packing radius; samples with 0 are not moved.
        rounds: number of repetitions.

    Returns:
        ``(K, 3)`` float64.
    """
    current, moved = samples.copy(), np.empty_like(samples)
    for _ in range(rounds):
        _push(current, normals, neighbours, radius, moved)
        current, moved = moved, current
    return current


@njit(cache=True, nogil=True, fastmath=True)
def _push(samples, normals, neighbours, radius, moved):  # type: ignore[no-untyped-def]
    """One round of repulsion; writes the new positions into ``moved``."""
    for i in range(len(samples)):
        position = samples[i, 0], samples[i, 1], samples[i, 2]
        moved[i, 0], moved[i, 1], moved[i, 2] = position
        if radius[i] == 0.0:
            continue
        inverse = 1.0 / (_RANGE * radius[i])
        close = _CLOSE / (inverse * inverse)
        a = b = c = 0.0
        for at in range(neighbours.shape[1]):
            j = neighbours[i, at]
            if j < 0:
                break
            x = position[0] - samples[j, 0]
            y = position[1] - samples[j, 1]
            z = position[2] - samples[j, 2]
            squared = max(x * x + y * y + z * z, _TINY)
            per = 1.0 / np.sqrt(squared)
            # Without a branch, since the processor could not predict it.
            w = max(1.0 - squared * per * inverse, 0.0)
            w *= w * per * min(_STRENGTH + close * per * per, _MOST)
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
        moved[i, 0] += shrink * a
        moved[i, 1] += shrink * b
        moved[i, 2] += shrink * c
