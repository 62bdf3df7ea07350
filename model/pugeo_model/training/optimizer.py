# SPDX-License-Identifier: Apache-2.0
"""Muon for the matrices inside the network, AdamW for everything else.

Muon turns the momentum of a matrix into the nearest orthogonal matrix, so that rare directions are
learned as fast as common ones. It knows nothing of vectors, and layers that read a few numbers or
write a few have nothing to make orthogonal.
"""

from typing import Any

import torch
from torch import nn

__all__ = ["Optimizer"]

_NARROW = 32  # channels below which a layer is an input or an output
_DECAY = 0.01  # Muon's own weight decay, times the rate as AdamW's


class Optimizer:
    """Both as one.

    Args:
        net: what is trained.
        rate: learning rate; Muon's steps are scaled to be as large as AdamW's.
        decay: AdamW's weight decay.
    """

    def __init__(self, net: nn.Module, rate: float, decay: float) -> None:
        parameters = list(net.parameters())
        inner = [p for p in parameters if p.ndim == 2 and min(p.shape) >= _NARROW]
        chosen = {id(p) for p in inner}
        others = [p for p in parameters if id(p) not in chosen]
        self._parts: list[torch.optim.Optimizer] = [
            torch.optim.AdamW(others, lr=rate, weight_decay=decay, fused=True)
        ]
        if inner:
            muon = torch.optim.Muon(
                inner, lr=rate, weight_decay=_DECAY, adjust_lr_fn="match_rms_adamw"
            )
            self._parts.append(muon)

    def step(self, rate: float) -> None:
        """Take a step at this learning rate."""
        for part in self._parts:
            for group in part.param_groups:
                group["lr"] = rate
            part.step()

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for part in self._parts:
            part.zero_grad(set_to_none=True)

    def state_dict(self) -> list[dict[str, Any]]:
        """What a checkpoint needs to go on exactly."""
        return [part.state_dict() for part in self._parts]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        """The inverse of :meth:`state_dict`."""
        for part, stored in zip(self._parts, state, strict=True):
            part.load_state_dict(stored)
