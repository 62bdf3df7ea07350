# SPDX-License-Identifier: Apache-2.0
"""What a backbone is given: tensors of one or several patches, rows of all patches in one.

Neighbours lie along the first dimension: pooling over them is then one contiguous pass a
neighbour, several times faster than a reduction in the middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pugeo_model.geometry.patches import MESSAGES, Patch, edges, poses, scalars

__all__ = ["Neighbourhoods", "gather"]


@dataclass(frozen=True, eq=False)
class Round:
    """One round of message passing: ``rows`` receive from ``sources``.

    Attributes:
        rows: ``(n,)`` int64 rows, of the round before, that receive.
        sources: ``(k, n)`` int64 rows, of the round before, that send.
        pose: ``(k, n, 16)`` float32, the sender's frame in the receiver's.
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
    rounds: tuple[Round, ...]


def gather(patches: Sequence[Patch]) -> Neighbourhoods:
    """Tensors of the patches, put one after the other as one graph without padding."""
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
            Round(
                _joined(rows),
                _joined(sources, axis=1),
                _joined(pose, axis=1),
            )
        )
        before = now
    return Neighbourhoods(
        _joined([edges(p) for p in patches], axis=1),
        _joined([scalars(p.frames) for p in patches]),
        tuple(rounds),
    )


def _joined(parts: Sequence[NDArray[Any]], axis: int = 0) -> Tensor:
    """Arrays one after the other; what is alone, as in serving, is not copied."""
    joined = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)
    return torch.from_numpy(joined)
