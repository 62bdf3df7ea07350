# SPDX-License-Identifier: Apache-2.0
"""Pooling over neighbours, which lie along the first dimension so that each pass is contiguous."""

from typing import Any

import torch
from numba import njit
from torch import Tensor

__all__ = ["max_pool", "mean_pool", "rectify"]


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
        _pass_on(*(_bits(tensor) for tensor in (values, top, grads[0], grad)))
        return grad


@njit(cache=True, nogil=True)
def _pass_on(values, top, above, grad):  # type: ignore[no-untyped-def]
    """A fifth of the time of torch's comparison and product, which convert to float32 and back."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            grad[i, j] = above[0, j] if values[i, j] == top[0, j] else 0


def _bits(tensor: Tensor) -> Any:
    """Numbers as integers, ``(k, n * c)`` or ``(1, n * c)``: numba knows no bfloat16."""
    kind = {2: torch.int16, 4: torch.int32, 8: torch.int64}[tensor.element_size()]
    rows = tensor.reshape(len(tensor) if tensor.dim() == 3 else 1, -1)
    return rows.view(kind).numpy()


class _Mean(torch.autograd.Function):
    """Mean over dimension 0, whose gradient is one row for all: nothing is multiplied out."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.count = len(values)
        return _mean(values)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        share: Tensor = (grads[0] / ctx.count).expand(ctx.count, *grads[0].shape)
        return share


def rectify(values: Tensor) -> Tensor:
    """ReLU, in place where no gradient is wanted.

    With one, torch keeps book of what was overwritten in a view: three passes more than a copy.
    """
    return torch.relu(values) if values.requires_grad else torch.relu_(values)


def max_pool(values: Tensor) -> Tensor:
    """``(k, n, c)``, output of a ReLU -> ``(n, c)``."""
    if not values.requires_grad:
        return values.amax(dim=0)
    pooled: Tensor = _Max.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def mean_pool(values: Tensor) -> Tensor:
    """``(k, n, c)`` -> ``(n, c)``."""
    if not values.requires_grad:
        return _mean(values)
    pooled: Tensor = _Mean.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def _mean(values: Tensor) -> Tensor:
    """As a product with a row of 1/k: a sum in bfloat16 is slow."""
    share = torch.full((1, len(values)), 1.0 / len(values), dtype=values.dtype)
    mean: Tensor = (share @ values.flatten(1)).reshape(values.shape[1:])
    return mean
