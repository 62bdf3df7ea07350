# SPDX-License-Identifier: Apache-2.0
"""Muon for the inner matrices of the network, AdamW for all other weights.

Muon is not defined for vectors and not useful for layers with few inputs or outputs.
"""

from typing import Any

import torch
from torch import nn

from pugeo_model.training.muon import Muon

__all__ = ["Optimizer"]

_NARROW = 32  # layers with fewer channels are trained by AdamW


class Optimizer:
    """Muon and AdamW as one optimizer.

    Args:
        net: the network to train.
        rate: learning rate; steps of Muon are scaled to the size of those of AdamW.
        decay: weight decay of AdamW.
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
            self._parts.append(Muon(inner, rate))

    def step(self, rate: float) -> None:
        """Update the weights with learning rate ``rate``."""
        for part in self._parts:
            for group in part.param_groups:
                group["lr"] = rate
            part.step()

    def zero_grad(self) -> None:
        """Reset all gradients."""
        for part in self._parts:
            part.zero_grad(set_to_none=True)

    def state_dict(self) -> list[dict[str, Any]]:
        """Return the state for a checkpoint."""
        return [part.state_dict() for part in self._parts]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        """Restore the result of :meth:`state_dict`."""
        for part, stored in zip(self._parts, state, strict=True):
            part.load_state_dict(stored)
