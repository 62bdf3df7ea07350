# SPDX-License-Identifier: Apache-2.0
"""Local canonical charts: features of neighbourhoods already turned, scaled and bent alike.

Sums and rectifications are done in place wherever no gradient needs what they overwrite: these
layers are bound by memory, not by arithmetic.
"""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.geometry.patches import EDGE, MESSAGES, POSE, SCALARS
from pugeo_model.network.neighbourhoods import Neighbourhoods, Round
from pugeo_model.network.pooling import max_pool, mean_pool, rectify

__all__ = ["ChartsBackbone"]

_SCALES = (8, 16, 32)
_STEPS = [stop - start for start, stop in itertools.pairwise((0, *_SCALES))]


class Recalibration(nn.Module):
    """Softmax weights over the scales of a hierarchical feature (paper, section 4.1, eq. 2).

    Args:
        scales: number of scales.
        width: channels of each.
    """

    def __init__(self, scales: int, width: int) -> None:
        super().__init__()
        self.scales = scales
        self.logits = nn.Linear(scales * width, scales)

    def forward(self, features: Tensor) -> Tensor:
        """``(n, scales * width)`` -> the same, each scale times its weight, mean weight 1."""
        weights = functional.softmax(self.logits(features).float(), dim=-1) * self.scales
        parts: Tensor = features.unflatten(-1, (self.scales, -1)) * weights.unsqueeze(-1).to(
            features.dtype
        )
        return parts.flatten(-2)


class Neighbours(nn.Module):
    """A small MLP on each neighbour, pooled at three scales and on average."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.first = nn.Linear(EDGE, width)
        self.second = nn.Linear(width, width)
        self.recalibration = Recalibration(len(_SCALES) + 1, width)
        self.out = nn.Linear((len(_SCALES) + 1) * width + SCALARS, out)

    def forward(self, edges: Tensor, scalars: Tensor) -> Tensor:
        """``(k, n, 5)``, ``(n, 9)`` -> ``(n, out)``."""
        each = rectify(self.second(rectify(self.first(edges))))
        # Neighbours come sorted by distance: the max over the first 16 grows from that over 8.
        pools: list[Tensor] = []
        # Split and not sliced: the gradients of slices are each written into zeros of full size.
        for part in each.split(_STEPS):
            pool = max_pool(part)
            pools.append(pool if not pools else torch.maximum(pool, pools[-1]))
        pools.append(mean_pool(each))
        hierarchy = self.recalibration(torch.cat(pools, dim=-1))
        return rectify(self.out(torch.cat([hierarchy, scalars.to(hierarchy.dtype)], -1)))


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
        self.receiver = nn.Linear(width, width)
        self.sender = nn.Linear(width, width, bias=False)
        self.pose = nn.Linear(POSE, width, bias=False)
        self.second = nn.Linear(width, width)
        self.out = nn.Linear(3 * width, width)
        self.norm = nn.LayerNorm(width)
        self.own: nn.Sequential | None = None
        if expansion:
            hidden = expansion * width
            self.own = nn.Sequential(
                nn.Linear(width, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, width)
            )

    def forward(self, features: Tensor, turn: Round) -> Tensor:
        """``(n, width)`` features of the outer ring -> ``(len(turn.rows), width)``."""
        own = features.index_select(0, turn.rows)
        sent = self.sender(features).index_select(0, turn.sources.flatten())
        sent = sent.unflatten(0, tuple(turn.sources.shape))
        each = rectify(self.pose(turn.pose).add_(sent).add_(self.receiver(own)))
        each = rectify(self.second(each))
        pooled = torch.cat([own, max_pool(each), mean_pool(each)], dim=-1)
        updated: Tensor = self.norm(own + rectify(self.out(pooled)))
        return updated if self.own is None else updated + self.own(updated)


class ChartsBackbone(nn.Module):
    """Features ``c_i`` of the core points of patches.

    Args:
        width: channels of the point features.
        edge_width: channels of the per-neighbour MLP.
        features: channels of the result.
        expansion: of each round's MLP on points, see ``Messages``.
    """

    def __init__(
        self, width: int = 128, edge_width: int = 64, features: int = 256, expansion: int = 0
    ) -> None:
        super().__init__()
        self.neighbours = Neighbours(edge_width, width)
        self.norm = nn.LayerNorm(width)
        self.messages = nn.ModuleList(Messages(width, expansion) for _ in MESSAGES)
        self.recalibration = Recalibration(len(MESSAGES) + 1, width)
        self.out = nn.Linear((len(MESSAGES) + 1) * width, features)

    def forward(self, hoods: Neighbourhoods) -> Tensor:
        """Features ``(n, features)``: the core rows in the order of the patches, then filling."""
        levels = [self.norm(self.neighbours(hoods.edges, hoods.scalars))]
        for layer, turn in zip(self.messages, hoods.rounds, strict=True):
            levels = [level.index_select(0, turn.rows) for level in levels[:-1]] + [levels[-1]]
            latest = layer(levels[-1], turn)
            levels = [*levels[:-1], levels[-1].index_select(0, turn.rows), latest]
        hierarchy = self.recalibration(torch.cat(levels, dim=-1))
        return rectify(self.out(hierarchy))
