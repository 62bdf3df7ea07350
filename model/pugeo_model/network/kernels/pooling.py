# SPDX-License-Identifier: Apache-2.0
"""What is done along neighbours: sums with what each sends, maxima and means.

Neighbours lie along the first dimension, so that every pass is contiguous. These passes are bound
by memory: where no gradient is wanted, what torch does in four is one.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from pugeo_model.network.kernels.bfloat16 import bits, to_bfloat16, to_float32

__all__ = ["pools", "rectify", "sums"]


def rectify(values: Tensor) -> Tensor:
    """ReLU, in place where no gradient is wanted.

    With one, torch keeps book of what was overwritten in a view: three passes more than a copy.
    """
    return torch.relu(values) if values.requires_grad else torch.relu_(values)


def sums(edges: Tensor, sent: Tensor, sources: Tensor, own: Tensor) -> Tensor:
    """What each edge adds up to, rectified; ``edges`` may be overwritten.

    Args:
        edges: ``(k, n, c)``.
        sent: ``(m, c)`` of the senders.
        sources: ``(k, n)`` int64 rows of ``sent``.
        own: ``(n, c)`` of the receivers.
    """
    if _served(edges):
        assert edges.dtype == sent.dtype == own.dtype
        _sum(bits(edges), bits(sent), sources.numpy(), bits(own))
        return edges
    gathered = sent.index_select(0, sources.flatten()).unflatten(0, tuple(sources.shape))
    return rectify(edges.add_(gathered).add_(own))


def pools(values: Tensor, stops: Sequence[int], before: Tensor | None = None) -> Tensor:
    """Maxima over the first neighbours and the mean over all, side by side.

    Args:
        values: ``(k, n, c)``, output of a ReLU.
        stops: over how many neighbours each maximum goes, ascending, the last of them ``k``.
        before: ``(n, b)`` columns that lead.

    Returns:
        ``(n, b + (len(stops) + 1) * c)``.
    """
    width = values.shape[2]
    leading = 0 if before is None else before.shape[1]
    if _served(values):
        columns = leading + (len(stops) + 1) * width
        out = torch.empty(values.shape[1], columns, dtype=values.dtype)
        if before is not None:
            out[:, :leading] = before
        _pool(bits(values), np.array(stops), float(_share(values)), bits(out), leading)
        return out
    parts = [] if before is None else [before]
    # Split and not sliced: the gradients of slices are each written into zeros of full size.
    steps = [stop - start for start, stop in itertools.pairwise((0, *stops))]
    top = None
    for part in values.split(steps):
        pool = _max(part)
        top = pool if top is None else torch.maximum(pool, top)
        parts.append(top)
    return torch.cat([*parts, _mean(values)], dim=-1)


def _served(values: Tensor) -> bool:
    return values.dtype == torch.bfloat16 and not torch.is_grad_enabled()


@njit(cache=True, nogil=True, fastmath=True)
def _sum(edges, sent, sources, own):  # type: ignore[no-untyped-def]
    zero = np.float32(0.0)
    count, rows, width = edges.shape
    for j in range(count):
        for i in range(rows):
            source = sources[j, i]
            for c in range(width):
                total = (
                    to_float32(edges[j, i, c]) + to_float32(sent[source, c]) + to_float32(own[i, c])
                )
                edges[j, i, c] = to_bfloat16(max(total, zero))


@njit(cache=True, nogil=True, fastmath=True)
def _pool(values, stops, share, out, first):  # type: ignore[no-untyped-def]
    """Bits of numbers that are not negative are in the order of the numbers."""
    _, rows, width = values.shape
    top, total = np.empty(width, dtype=np.int16), np.empty(width, dtype=np.float32)
    share = np.float32(share)
    for i in range(rows):
        top[:] = 0
        total[:] = 0.0
        begun, at = 0, first
        for stop in stops:
            for j in range(begun, stop):
                for c in range(width):
                    top[c] = max(top[c], values[j, i, c])
                    total[c] += to_float32(values[j, i, c])
            out[i, at : at + width] = top
            begun, at = stop, at + width
        for c in range(width):
            out[i, at + c] = to_bfloat16(share * total[c])


class _Max(torch.autograd.Function):
    """Maximum over dimension 0.

    Torch's own maximum keeps indices (13 times slower here) or counts ties in its gradient. Behind
    a ReLU ties only happen at zero, where no gradient passes anyway.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        top = values.amax(dim=0)
        ctx.save_for_backward(values, top)
        return top

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        values, top = ctx.saved_tensors
        grad = torch.empty(values.shape, dtype=values.dtype)
        flat = [tensor.reshape(-1, top.numel()) for tensor in (values, top, grads[0], grad)]
        _pass_on(*(bits(tensor) for tensor in flat))
        return grad


@njit(cache=True, nogil=True)
def _pass_on(values, top, above, grad):  # type: ignore[no-untyped-def]
    """A fifth of the time of torch's comparison and product, which convert to float32 and back."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            grad[i, j] = above[0, j] if values[i, j] == top[0, j] else 0


class _Mean(torch.autograd.Function):
    """Mean over dimension 0, whose gradient is one row for all: nothing is multiplied out."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.count = len(values)
        # As a product: a sum in bfloat16 is slow.
        mean: Tensor = (_share(values).expand(1, len(values)) @ values.flatten(1)).reshape(
            values.shape[1:]
        )
        return mean

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        share: Tensor = (grads[0] / ctx.count).expand(ctx.count, *grads[0].shape)
        return share


def _max(values: Tensor) -> Tensor:
    """``(k, n, c)``, output of a ReLU -> ``(n, c)``."""
    pooled: Tensor = _Max.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def _mean(values: Tensor) -> Tensor:
    """``(k, n, c)`` -> ``(n, c)``."""
    pooled: Tensor = _Mean.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def _share(values: Tensor) -> Tensor:
    """What one neighbour is of the mean over all, rounded as the numbers are."""
    return torch.tensor(1.0 / len(values), dtype=values.dtype)
