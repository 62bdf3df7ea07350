# SPDX-License-Identifier: Apache-2.0
"""Inputs of a backbone: tensors of one or several patches, concatenated along the points.

Neighbours are the first dimension, so that pooling over them is one contiguous pass per
neighbour, several times faster than a reduction of a middle dimension.

Points are padded with zeros to multiples of ``_GRAIN``; features of the padding are discarded.
oneDNN compiles a matrix product for each new number of rows, and patches differ in size: without
padding this took a quarter of the time of the network and 0.5 GB of memory.
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

_GRAIN = 128  # 64, 128, 256 rows add 3, 4, 9 % of work; larger ones need fewer compiled products


@dataclass(frozen=True, eq=False)
class MessageRound:
    """One round of message passing from ``sources`` to ``rows``.

    Attributes:
        rows: ``(n,)`` int64 receiving rows of the previous round; row 0 for the padding.
        sources: ``(k, n)`` int64 sending rows of the previous round.
        pose: ``(k, n, POSE)`` float32, frame of the sender relative to that of the receiver.
    """

    rows: Tensor
    sources: Tensor
    pose: Tensor


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """Inputs of a backbone.

    Attributes:
        edges: ``(k, n, 5)`` float32, neighbours in canonical frames, lengths in spacings.
        scalars: ``(n, 9)`` float32, features of each point from the quadric fit.
        rounds: rounds of message passing, outermost ring first.
    """

    edges: Tensor
    scalars: Tensor
    rounds: tuple[MessageRound, ...]


def stack_patches(patches: Sequence[Patch]) -> Neighbourhoods:
    """Convert patches to tensors: one graph of all patches, padded.

    Args:
        patches: at least one.
    """
    rounds = []
    senders = [patch.rings[0] for patch in patches]
    for number, columns in enumerate(MESSAGES):
        starts = np.cumsum([0, *senders[:-1]])
        receivers = [(*p.rings, p.core)[number + 1] for p in patches]
        rows = [s + np.arange(n) for s, n in zip(starts, receivers, strict=True)]
        sources = [
            s + np.ascontiguousarray(p.neighbours[:n, slice(*columns)].T, dtype=np.int64)
            for p, s, n in zip(patches, starts, receivers, strict=True)
        ]
        pose = [poses(p, n, columns) for p, n in zip(patches, receivers, strict=True)]
        rounds.append(
            MessageRound(
                _pad(_join(rows), 0),
                _pad(_join(sources, axis=1), 1),
                _pad(_join(pose, axis=1), 1),
            )
        )
        senders = receivers
    return Neighbourhoods(
        _pad(_join([edges(p) for p in patches], axis=1), 1),
        _pad(_join([scalars(p.frames) for p in patches]), 0),
        tuple(rounds),
    )


def _join(parts: Sequence[NDArray[Any]], axis: int = 0) -> Tensor:
    """Concatenate arrays; a single one is not copied."""
    joined = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)
    return torch.from_numpy(joined)


def _pad(tensor: Tensor, axis: int) -> Tensor:
    """Append zeros along ``axis`` up to a multiple of ``_GRAIN``."""
    missing = -tensor.shape[axis] % _GRAIN
    widths = [0, 0] * (tensor.dim() - 1 - axis) + [0, missing]
    return functional.pad(tensor, widths) if missing else tensor
