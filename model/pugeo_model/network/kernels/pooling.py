# SPDX-License-Identifier: Apache-2.0
"""Sums of messages, maxima and means over neighbours.

Neighbours are the first dimension, so that each pass is contiguous. These passes are limited by
memory bandwidth; without gradients one compiled pass replaces four of torch.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pugeo_model.kernel_compiler import njit
from pugeo_model.network.kernels.bfloat16 import bits, to_bfloat16, to_float32

__all__ = ["pools", "rectify", "sums"]


def rectify(values: Tensor) -> Tensor:
    """Apply a ReLU, in place if no gradient is needed.

    With gradients, torch's bookkeeping for in-place changes of a view takes three more passes.
    """
    return torch.relu(values) if values.requires_grad else torch.relu_(values)


def sums(edges: Tensor, sent: Tensor, sources: Tensor, received: Tensor) -> Tensor:
    """Compute ``relu(edge + sender + receiver)`` for each edge.

    Args:
        edges: ``(k, n, c)`` part of each edge; may be overwritten.
        sent: ``(m, c)`` part of the senders.
        sources: ``(k, n)`` int64 rows of ``sent``.
        received: ``(n, c)`` part of the receivers.

    Returns:
        ``(k, n, c)``.
    """
    if _uses_kernel(edges):
        assert edges.dtype == sent.dtype == received.dtype
        _sum(bits(edges), bits(sent), sources.numpy(), bits(received))
        return edges
    gathered = sent.index_select(0, sources.flatten()).unflatten(0, tuple(sources.shape))
    return rectify(edges.add_(gathered).add_(received))


def pools(values: Tensor, stops: Sequence[int], before: Tensor | None = None) -> Tensor:
    """Compute maxima over leading neighbours and the mean over all, concatenated.

    Args:
        values: ``(k, n, c)``, output of a ReLU.
        stops: number of leading neighbours of each maximum, ascending; the last one is ``k``.
        before: ``(n, b)`` columns to put first.

    Returns:
        ``(n, b + (len(stops) + 1) * c)``.
    """
    width = values.shape[2]
    leading = 0 if before is None else before.shape[1]
    if _uses_kernel(values):
        columns = leading + (len(stops) + 1) * width
        out = torch.empty(values.shape[1], columns, dtype=values.dtype)
        if before is not None:
            out[:, :leading] = before
        _pool(bits(values), np.array(stops), float(_inverse_count(values)), bits(out), leading)
        return out
    parts = [] if before is None else [before]
    # `split` and not slices: the gradient of each slice would be a zero tensor of full size.
    steps = [stop - start for start, stop in itertools.pairwise((0, *stops))]
    top = None
    for part in values.split(steps):
        pool = _max(part)
        top = pool if top is None else torch.maximum(pool, top)
        parts.append(top)
    return torch.cat([*parts, _mean(values)], dim=-1)


def _uses_kernel(values: Tensor) -> bool:
    """Return whether the compiled kernels apply: bfloat16 without gradients."""
    return values.dtype == torch.bfloat16 and not torch.is_grad_enabled()


@njit(cache=True, nogil=True, fastmath=True)
def _sum(edges, sent, sources, received):  # type: ignore[no-untyped-def]
    """Compute `sums` in place of ``edges``, on bits of bfloat16."""
    zero = np.float32(0.0)
    count, rows, width = edges.shape
    for j in range(count):
        for i in range(rows):
            source = sources[j, i]
            for c in range(width):
                total = (
                    to_float32(edges[j, i, c])
                    + to_float32(sent[source, c])
                    + to_float32(received[i, c])
                )
                edges[j, i, c] = to_bfloat16(max(total, zero))


@njit(cache=True, nogil=True, fastmath=True)
def _pool(values, stops, inverse_count, out, first):  # type: ignore[no-untyped-def]
    """Compute `pools` on bits of bfloat16; bits of non-negative numbers sort as the numbers."""
    _, rows, width = values.shape
    top, total = np.empty(width, dtype=np.int16), np.empty(width, dtype=np.float32)
    inverse_count = np.float32(inverse_count)
    for i in range(rows):
        top[:] = 0
        total[:] = 0.0
        start, at = 0, first
        for stop in stops:
            for j in range(start, stop):
                for c in range(width):
                    top[c] = max(top[c], values[j, i, c])
                    total[c] += to_float32(values[j, i, c])
            out[i, at : at + width] = top
            start, at = stop, at + width
        for c in range(width):
            out[i, at + c] = to_bfloat16(inverse_count * total[c])


class _Max(torch.autograd.Function):
    """Maximum over dimension 0 with a fast gradient.

    Torch's own maximum stores indices (13 times slower here) or divides the gradient among ties.
    After a ReLU ties occur at zero only, where the gradient is zero.
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
        _max_gradient(*(bits(tensor) for tensor in flat))
        return grad


@njit(cache=True, nogil=True)
def _max_gradient(values, top, above, grad):  # type: ignore[no-untyped-def]
    """Gradient of the maximum, in a fifth of the time of torch's comparison and product."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            grad[i, j] = above[0, j] if values[i, j] == top[0, j] else 0


class _Mean(torch.autograd.Function):
    """Mean over dimension 0; the gradient is one expanded row and not a full tensor."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.count = len(values)
        # As a matrix product, since a sum in bfloat16 is slow.
        weights = _inverse_count(values).expand(1, len(values))
        mean: Tensor = (weights @ values.flatten(1)).reshape(values.shape[1:])
        return mean

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        grad: Tensor = (grads[0] / ctx.count).expand(ctx.count, *grads[0].shape)
        return grad


def _max(values: Tensor) -> Tensor:
    """``(k, n, c)``, output of a ReLU -> ``(n, c)``."""
    pooled: Tensor = _Max.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def _mean(values: Tensor) -> Tensor:
    """``(k, n, c)`` -> ``(n, c)``."""
    pooled: Tensor = _Mean.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def _inverse_count(values: Tensor) -> Tensor:
    """Weight of one neighbour in the mean over all, in the dtype of the values."""
    return torch.tensor(1.0 / len(values), dtype=values.dtype)
