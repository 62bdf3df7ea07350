# SPDX-License-Identifier: Apache-2.0
"""Pooling over neighbours, which lie along the first dimension so that each pass is contiguous."""

from typing import Any

import torch
from torch import Tensor

__all__ = ["max_pool", "mean_pool"]


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
        passed: Tensor = (values == top) * grads[0]
        return passed


def max_pool(values: Tensor) -> Tensor:
    """``(k, n, c)``, output of a ReLU -> ``(n, c)``."""
    if not values.requires_grad:
        return values.amax(dim=0)
    pooled: Tensor = _Max.apply(values)  # type: ignore[no-untyped-call]  # torch has no types here
    return pooled


def mean_pool(values: Tensor) -> Tensor:
    """``(k, n, c)`` -> ``(n, c)``, as a product with a row of 1/k: a sum in bfloat16 is slow."""
    share = torch.full((1, len(values)), 1.0 / len(values), dtype=values.dtype)
    return (share @ values.flatten(1)).reshape(values.shape[1:])
