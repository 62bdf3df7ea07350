# SPDX-License-Identifier: Apache-2.0
"""Muon (Jordan et al. 2024) in float32.

Muon replaces the momentum of a matrix by the nearest orthogonal matrix, so that rare directions are
learned as fast as frequent ones. `torch.optim.Muon` iterates in bfloat16, which CPUs without such
units emulate: there it took six tenths of a training step.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn

__all__ = ["Muon", "orthogonalised"]

_MOMENTUM = 0.95
_DECAY = 0.01  # weight decay, multiplied by the learning rate
_A, _B, _C = 3.4445, -4.7750, 2.0315  # of the quintic, from Jordan's publication
_ROUNDS = 5


class Muon(torch.optim.Optimizer):
    """Muon with Nesterov momentum; steps have the size of those of AdamW (Liu et al. 2025).

    Args:
        parameters: matrices.
        lr: learning rate.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float) -> None:
        super().__init__(parameters, {"lr": lr})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]  # noqa: ARG002
        """Update the matrices by their gradients; ``closure`` is not used."""
        for group in self.param_groups:
            for parameter in group["params"]:
                self._update(parameter, group["lr"])

    def _update(self, parameter: nn.Parameter, rate: float) -> None:
        gradient = parameter.grad
        if gradient is None:
            return
        state: dict[str, Any] = self.state[parameter]
        if not state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        momentum = state["momentum_buffer"].lerp_(gradient, 1.0 - _MOMENTUM)
        update = orthogonalised(gradient.lerp(momentum, _MOMENTUM))
        size = 0.2 * math.sqrt(max(parameter.shape))
        parameter.mul_(1.0 - rate * _DECAY).add_(update, alpha=-rate * size)


def orthogonalised(matrix: torch.Tensor) -> torch.Tensor:
    """Bring all singular values of a matrix near 1, by Newton-Schulz iteration.

    Args:
        matrix: ``(m, n)`` float32.

    Returns:
        ``(m, n)`` with the same singular vectors. Singular values are between 0.68 and 1.21, apart
        from those that were below a hundredth of the norm of the matrix, which are smaller.
    """
    wide = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    wide = wide / wide.norm().clamp(min=1e-7)
    for _ in range(_ROUNDS):
        gram = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=_B, alpha=_C), wide, beta=_A)
    return wide.T if matrix.shape[0] > matrix.shape[1] else wide
