# SPDX-License-Identifier: Apache-2.0
"""What a backbone is given: tensors of one or several patches, rows of all patches in one.

Neighbours lie along the first dimension: pooling over them is then one contiguous pass a
neighbour, several times faster than a reduction in the middle.

Points are filled up to multiples of ``_GRAIN`` with points of zeros, whose features nobody asks
for. Torch compiles a product anew for every number of rows that it has not met, and no two patches
are alike: that took a quarter of the network's time, and 0.5 GB for what it keeps of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from pugeo_model.geometry.patches import MESSAGES, Patch, edges, poses, scalars

__all__ = ["Neighbourhoods", "stack_patches"]

_GRAIN = 128  # of 64, 128, 256 rows: 3, 4 and 9 % more work, and fewer products to compile


@dataclass(frozen=True, eq=False)
class MessageRound:
    """One round of message passing: ``rows`` receive from ``sources``.

    Attributes:
        rows: ``(n,)`` int64 rows, of the round before, that receive; what fills up is row 0.
        sources: ``(k, n)`` int64 rows, of the round before, that send.
        pose: ``(k, n, POSE)`` float32, the sender's frame in the receiver's.
    """

    rows: Tensor
    sources: Tensor
    pose: Tensor


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """Inputs of a backbone.

    Attributes:
        edges: ``(k, n, 5)`` float32, neighbours in canonical frames, lengths in spacings.
        scalars: ``(n, 9)`` float32, what the quadric fit knows of each point.
        rounds: one entry a round of message passing, outermost ring first.
    """

    edges: Tensor
    scalars: Tensor
    rounds: tuple[MessageRound, ...]


def stack_patches(patches: Sequence[Patch]) -> Neighbourhoods:
    """Tensors of the patches, put one after the other as one graph, and filled up."""
    rounds = []
    before = [patch.rings[0] for patch in patches]
    for turn, reach in enumerate(MESSAGES):
        starts = np.cumsum([0, *before[:-1]])
        now = [(*p.rings, p.core)[turn + 1] for p in patches]
        rows = [s + np.arange(n) for s, n in zip(starts, now, strict=True)]
        sources = [
            s + np.ascontiguousarray(p.neighbours[:n, slice(*reach)].T, dtype=np.int64)
            for p, s, n in zip(patches, starts, now, strict=True)
        ]
        pose = [poses(p, n, reach) for p, n in zip(patches, now, strict=True)]
        rounds.append(
            MessageRound(
                _filled(_joined(rows), 0),
                _filled(_joined(sources, axis=1), 1),
                _filled(_joined(pose, axis=1), 1),
            )
        )
        before = now
    return Neighbourhoods(
        _filled(_joined([edges(p) for p in patches], axis=1), 1),
        _filled(_joined([scalars(p.frames) for p in patches]), 0),
        tuple(rounds),
    )


def _joined(parts: Sequence[NDArray[Any]], axis: int = 0) -> Tensor:
    """Arrays one after the other."""
    joined = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)
    return torch.from_numpy(joined)


def _filled(tensor: Tensor, axis: int) -> Tensor:
    """Zeros behind the rows along ``axis``, up to a multiple of the grain."""
    missing = -tensor.shape[axis] % _GRAIN
    behind = [0, 0] * (tensor.dim() - 1 - axis) + [0, missing]
    return functional.pad(tensor, behind) if missing else tensor
