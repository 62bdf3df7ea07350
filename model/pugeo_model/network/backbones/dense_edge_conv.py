# SPDX-License-Identifier: Apache-2.0
"""Densely connected EdgeConv features of MPU (Wang et al. 2019, section 3.2)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones.edge_conv import EdgeConv, PointMLP, knn_graph

__all__ = ["DenseEdgeConv", "DenseFeatures"]


class DenseEdgeConv(nn.Module):
    """Edge features whose layers see all layers before them, then the maximum over neighbours.

    The first layer reads ``[x_i, x_j - x_i]`` (see :class:`EdgeConv`), each later one its
    predecessors' outputs and ``x_i``; what it reads of ``x_i`` is multiplied once a point.

    Args:
        inputs: channels of the points.
        growth: channels of every layer.
        layers: of the edge MLP.
    """

    def __init__(self, inputs: int, growth: int = 24, layers: int = 3) -> None:
        super().__init__()
        self.first = EdgeConv(inputs, growth, norm=False)
        self.own = nn.ModuleList(nn.Linear(inputs, growth) for _ in range(layers - 1))
        self.deeper = nn.ModuleList(
            nn.Linear(growth * (layer + 1), growth, bias=False) for layer in range(layers - 1)
        )
        self.outputs = inputs + growth * layers

    def forward(self, features: Tensor, graph: Tensor) -> Tensor:
        """``(n, inputs)``, ``(k, n)`` -> ``(n, inputs + growth * layers)``."""
        edges = self.first.edges(features, graph)
        for number, (own, layer) in enumerate(zip(self.own, self.deeper, strict=True)):
            grown = layer(edges) + own(features)
            last = number == len(self.own) - 1
            edges = torch.cat([grown if last else functional.relu(grown), edges], dim=-1)
        return torch.cat([edges.amax(dim=0), features], dim=-1)


class DenseFeatures(nn.Module):
    """Four dense blocks on dynamic graphs, inputs of each reduced to ``growth * 2`` channels.

    Args:
        k: neighbours.
        growth: channels of an edge layer.
        blocks: number of blocks.
    """

    def __init__(self, k: int = 16, growth: int = 24, blocks: int = 4) -> None:
        super().__init__()
        self.k = k
        width = 2 * growth
        self.lift = nn.Linear(3, growth)
        self.blocks, self.reduce = nn.ModuleList(), nn.ModuleList()
        total = growth
        for block in range(blocks):
            inputs = growth
            if block:
                self.reduce.append(PointMLP(total, width, norm=False))
                inputs = width
            made = DenseEdgeConv(inputs, growth)
            self.blocks.append(made)
            total += made.outputs
        self.features = total

    def forward(self, points: Tensor) -> Tensor:
        """``(B, N, 3)`` -> ``(B, N, features)``: the outputs of all blocks."""
        batch, count, _ = points.shape
        level = self.lift(points.flatten(0, 1))
        known = level
        for number, block in enumerate(self.blocks):
            if number:
                level = self.reduce[number - 1](known)
            at = points if number == 0 else level.unflatten(0, (batch, count))
            known = torch.cat([block(level, knn_graph(at, self.k)), known], dim=-1)
        features: Tensor = known.unflatten(0, (batch, count))
        return features
