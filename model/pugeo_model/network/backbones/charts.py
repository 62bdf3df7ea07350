# SPDX-License-Identifier: Apache-2.0
"""Local canonical charts: features of neighbourhoods already turned, scaled and bent alike.

Sums and rectifications are done in place wherever no gradient needs what they overwrite: these
layers are bound by memory, not by arithmetic.
"""

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.geometry.patches import EDGE, MESSAGES, POSE, SCALARS
from pugeo_model.network.linear import Linear, Rectified
from pugeo_model.network.neighbourhoods import Neighbourhoods, Round
from pugeo_model.network.pooling import pools, sums

__all__ = ["ChartsBackbone"]

_SCALES = (8, 16, 32)


class Recalibration(nn.Module):
    """Softmax weights over the scales of a hierarchical feature (paper, section 4.1, eq. 2).

    Args:
        scales: number of scales.
        width: channels of each.
        learned: weigh the scales; all weights are 1 otherwise (ablation of Table 3).
    """

    def __init__(self, scales: int, width: int, *, learned: bool = True) -> None:
        super().__init__()
        self.scales = scales
        self.logits = Linear(scales * width, scales) if learned else None

    def forward(self, features: Tensor) -> Tensor:
        """``(n, scales * width)`` -> the same, each scale times its weight, mean weight 1."""
        if self.logits is None:
            return features
        weights = functional.softmax(self.logits(features).float(), dim=-1) * self.scales
        parts: Tensor = features.unflatten(-1, (self.scales, -1)) * weights.unsqueeze(-1).to(
            features.dtype
        )
        return parts.flatten(-2)


class Neighbours(nn.Module):
    """A small MLP on each neighbour, pooled at three scales and on average."""

    def __init__(self, width: int, out: int, *, recalibrate: bool) -> None:
        super().__init__()
        self.first = Rectified(EDGE, width)
        self.second = Rectified(width, width)
        self.recalibration = Recalibration(len(_SCALES) + 1, width, learned=recalibrate)
        self.out = Rectified((len(_SCALES) + 1) * width + SCALARS, out)

    def forward(self, edges: Tensor, scalars: Tensor) -> Tensor:
        """``(k, n, 5)``, ``(n, 9)`` -> ``(n, out)``."""
        each = self.second(self.first(edges))
        # Neighbours come sorted by distance: the nearest 8 are the finest scale.
        hierarchy = self.recalibration(pools(each, _SCALES))
        out: Tensor = self.out(torch.cat([hierarchy, scalars.to(hierarchy.dtype)], dim=-1))
        return out


class Messages(nn.Module):
    """One round of message passing with the senders' relative frames, then thought on the result.

    The first layer of an edge MLP on ``[f_i, f_j, pose]`` is split by linearity, so that its two
    wide products are made once a point and not once an edge. What needs no neighbour is left to
    an MLP of each point's own: a twelfth of the cost for the same number of weights.

    Args:
        width: channels.
        expansion: hidden channels of the point's own MLP, in widths; 0 for none.
    """

    def __init__(self, width: int, expansion: int) -> None:
        super().__init__()
        self.receiver = Linear(width, width)
        self.sender = Linear(width, width, bias=False)
        self.pose = Linear(POSE, width, bias=False)
        self.second = Rectified(width, width)
        self.out = Rectified(3 * width, width)
        self.norm = nn.LayerNorm(width)
        self.own: nn.Sequential | None = None
        if expansion:
            hidden = expansion * width
            layers = {"0": Rectified(width, hidden), "2": Linear(hidden, width)}
            self.own = nn.Sequential(OrderedDict(layers))

    def forward(self, features: Tensor, turn: Round) -> Tensor:
        """``(n, width)`` features of the outer ring -> ``(len(turn.rows), width)``."""
        own = features.index_select(0, turn.rows)
        each = sums(self.pose(turn.pose), self.sender(features), turn.sources, self.receiver(own))
        pooled = pools(self.second(each), [len(each)], own)
        updated: Tensor = self.norm(own + self.out(pooled))
        return updated if self.own is None else updated + self.own(updated)


class ChartsBackbone(nn.Module):
    """Features ``c_i`` of the core points of patches.

    Args:
        width: channels of the point features.
        edge_width: channels of the per-neighbour MLP.
        features: channels of the result.
        expansion: of each round's MLP on points, see ``Messages``.
        recalibrate: weigh scales and levels by a softmax; plain concatenation otherwise.
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
        """Features ``(n, features)``: the core rows in the order of the patches, then filling."""
        levels = [self.norm(self.neighbours(hoods.edges, hoods.scalars))]
        for layer, turn in zip(self.messages, hoods.rounds, strict=True):
            levels = [level.index_select(0, turn.rows) for level in levels[:-1]] + [levels[-1]]
            latest = layer(levels[-1], turn)
            levels = [*levels[:-1], levels[-1].index_select(0, turn.rows), latest]
        hierarchy = self.recalibration(torch.cat(levels, dim=-1))
        out: Tensor = self.out(hierarchy)
        return out
