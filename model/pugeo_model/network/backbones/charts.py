# SPDX-License-Identifier: Apache-2.0
"""Backbone on neighbourhoods in canonical frames: point features with message passing.

Sums and ReLUs are done in place where no gradient needs the overwritten values, since these
layers are limited by memory bandwidth.
"""

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.geometry.patches import EDGE, MESSAGES, POSE, SCALARS
from pugeo_model.network.kernels.pooling import pools, sums
from pugeo_model.network.linear import Linear, Rectified
from pugeo_model.network.neighbourhoods import MessageRound, Neighbourhoods

__all__ = ["ChartsBackbone"]

_SCALES = (8, 16, 32)


class Recalibration(nn.Module):
    """Feature recalibration: softmax weights over scales (paper, section 4.1, eq. 2).

    Args:
        scales: number of scales.
        width: channels of each.
        learned: learn the weights; all are 1 otherwise (ablation of Table 3).
    """

    def __init__(self, scales: int, width: int, *, learned: bool = True) -> None:
        super().__init__()
        self.scales = scales
        self.logits = Linear(scales * width, scales) if learned else None

    def forward(self, features: Tensor) -> Tensor:
        """Multiply each scale by its weight, of mean 1; ``(n, scales * width)`` -> the same."""
        if self.logits is None:
            return features
        weights = functional.softmax(self.logits(features).float(), dim=-1) * self.scales
        parts: Tensor = features.unflatten(-1, (self.scales, -1)) * weights.unsqueeze(-1).to(
            features.dtype
        )
        return parts.flatten(-2)


class Neighbours(nn.Module):
    """An MLP on each neighbour, then maxima over three scales and the mean over all neighbours.

    Args:
        width: channels of the MLP.
        out: channels of the result.
        recalibrate: weight the scales.
    """

    def __init__(self, width: int, out: int, *, recalibrate: bool) -> None:
        super().__init__()
        self.first = Rectified(EDGE, width)
        self.second = Rectified(width, width)
        self.recalibration = Recalibration(len(_SCALES) + 1, width, learned=recalibrate)
        self.out = Rectified((len(_SCALES) + 1) * width + SCALARS, out)

    def forward(self, edges: Tensor, scalars: Tensor) -> Tensor:
        """Features of edges ``(k, n, 5)`` and points ``(n, 9)`` -> ``(n, out)``."""
        neighbours = self.second(self.first(edges))
        # Neighbours are sorted by distance, so the nearest 8 are the finest scale.
        hierarchy = self.recalibration(pools(neighbours, _SCALES))
        out: Tensor = self.out(torch.cat([hierarchy, scalars.to(hierarchy.dtype)], dim=-1))
        return out


class Messages(nn.Module):
    """One round of message passing with relative frames, then an MLP on each point.

    The first layer of the edge MLP on ``[f_i, f_j, pose]`` is split by linearity, so that its two
    wide products are computed once per point and not once per edge. The MLP on points costs a
    twelfth of one on edges with the same number of weights.

    Args:
        width: channels.
        expansion: hidden channels of the MLP on points, in widths; 0 for none.
    """

    def __init__(self, width: int, expansion: int) -> None:
        super().__init__()
        self.receiver = Linear(width, width)
        self.sender = Linear(width, width, bias=False)
        self.pose = Linear(POSE, width, bias=False)
        self.second = Rectified(width, width)
        self.out = Rectified(3 * width, width)
        self.norm = nn.LayerNorm(width)
        # The name is part of the released weights.
        self.own: nn.Sequential | None = None
        if expansion:
            hidden = expansion * width
            layers = {"0": Rectified(width, hidden), "2": Linear(hidden, width)}
            self.own = nn.Sequential(OrderedDict(layers))

    def forward(self, features: Tensor, message_round: MessageRound) -> Tensor:
        """Features of the outer ring ``(n, width)`` -> features of the receivers ``(m, width)``."""
        receivers = features.index_select(0, message_round.rows)
        messages = sums(
            self.pose(message_round.pose),
            self.sender(features),
            message_round.sources,
            self.receiver(receivers),
        )
        pooled = pools(self.second(messages), [len(messages)], receivers)
        updated: Tensor = self.norm(receivers + self.out(pooled))
        return updated if self.own is None else updated + self.own(updated)


class ChartsBackbone(nn.Module):
    """Features ``c_i`` of the core points of patches (paper, section 4.1).

    Args:
        width: channels of the point features.
        edge_width: channels of the MLP on neighbours.
        features: channels of the result.
        expansion: hidden channels of the MLP on points, see `Messages`.
    """

    def __init__(
        self,
        width: int = 128,
        edge_width: int = 64,
        features: int = 256,
        expansion: int = 0,
        *,
        recalibrate: bool = True,
    ) -> None:
        super().__init__()
        self.neighbours = Neighbours(edge_width, width, recalibrate=recalibrate)
        self.norm = nn.LayerNorm(width)
        self.messages = nn.ModuleList(Messages(width, expansion) for _ in MESSAGES)
        self.recalibration = Recalibration(len(MESSAGES) + 1, width, learned=recalibrate)
        self.out = Rectified((len(MESSAGES) + 1) * width, features)

    def forward(self, hoods: Neighbourhoods) -> Tensor:
        """Return features ``(n, features)``: core rows in the order of the patches, padding."""
        levels = [self.norm(self.neighbours(hoods.edges, hoods.scalars))]
        for layer, each in zip(self.messages, hoods.rounds, strict=True):
            levels = [level.index_select(0, each.rows) for level in levels[:-1]] + [levels[-1]]
            latest = layer(levels[-1], each)
            levels = [*levels[:-1], levels[-1].index_select(0, each.rows), latest]
        hierarchy = self.recalibration(torch.cat(levels, dim=-1))
        out: Tensor = self.out(hierarchy)
        return out
