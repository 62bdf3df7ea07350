# SPDX-License-Identifier: Apache-2.0
"""EdgeConv on a k-nearest-neighbour graph (Wang et al., DGCNN, 2019), by exact linear algebra."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.kernels.pooling import pools, rectify

__all__ = ["EdgeConv", "PointMLP", "knn_graph"]


def knn_graph(features: Tensor, k: int) -> Tensor:
    """Rows of the ``k`` nearest points of every point, the point itself among them.

    Args:
        features: ``(B, N, C)`` float32, the space in which distances are taken.
        k: neighbours; at most ``N``.

    Returns:
        ``(k, B * N)`` int64 rows of the flattened ``(B * N, C)`` features. Neighbours lie along
        the first dimension, so that pooling over them is a contiguous pass.
    """
    batch, count, _ = features.shape
    with torch.no_grad():
        squared = features.square().sum(-1)
        # |a - b|^2 up to |a|^2, which is the same for all neighbours of a.
        apart = squared.unsqueeze(1) - 2.0 * features @ features.mT
        near = apart.topk(k, dim=-1, largest=False, sorted=False).indices
        start = count * torch.arange(batch).view(-1, 1, 1)
        return (near + start).flatten(0, 1).T.contiguous()


class PointMLP(nn.Sequential):
    """One layer of a shared MLP, ``(n, in)`` -> ``(n, out)``: linear, batch norm if wanted, ReLU.

    Args:
        inputs: channels in.
        outputs: channels out.
        norm: normalise each channel over the batch (DGCNN does).
    """

    def __init__(self, inputs: int, outputs: int, *, norm: bool) -> None:
        linear = nn.Linear(inputs, outputs, bias=not norm)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        if not norm:
            nn.init.zeros_(linear.bias)
        super().__init__(linear, nn.BatchNorm1d(outputs) if norm else nn.Identity(), nn.ReLU())


class EdgeConv(nn.Module):
    """Edge features ``h(W [x_i, x_j - x_i] + b)``, pooled over the neighbours ``j`` of ``i``.

    The product is made per point and not per edge:
    ``W [x_i, x_j - x_i] = (W1 - W2) x_i + W2 x_j`` with ``W = [W1, W2]``. This is exact; only the
    order of the float32 additions differs.

    Args:
        inputs: channels of the points.
        width: channels of the edges.
        layers: layers of the edge MLP; those after the first work on every edge.
        norm: batch norm after every linear layer, with statistics over the edges.
    """

    def __init__(self, inputs: int, width: int, layers: int = 1, *, norm: bool) -> None:
        super().__init__()
        self.inputs = inputs
        first = nn.Linear(2 * inputs, width)
        nn.init.kaiming_normal_(first.weight, nonlinearity="relu")
        nn.init.zeros_(first.bias)
        self.first = first
        self.norm = nn.BatchNorm1d(width) if norm else None
        self.deeper = nn.Sequential(*(PointMLP(width, width, norm=norm) for _ in range(layers - 1)))

    def edges(self, features: Tensor, graph: Tensor) -> Tensor:
        """Edge features before pooling, ``(k, n, width)``.

        Args:
            features: ``(n, inputs)``.
            graph: ``(k, n)`` int64 rows of ``features``.
        """
        own, offset = self.first.weight.split(self.inputs, dim=1)
        centre = functional.linear(features, own - offset, self.first.bias)
        sent = functional.linear(features, offset)
        gathered = sent.index_select(0, graph.flatten()).unflatten(0, tuple(graph.shape))
        edges: Tensor = gathered.add_(centre)
        if self.norm is not None:
            edges = self.norm(edges.flatten(0, 1)).unflatten(0, tuple(graph.shape))
        edges = rectify(edges)
        if len(self.deeper):
            edges = self.deeper(edges.flatten(0, 1)).unflatten(0, tuple(graph.shape))
        return edges

    def forward(self, features: Tensor, graph: Tensor) -> Tensor:
        """``(n, inputs)``, ``(k, n)`` -> maximum and mean over neighbours, ``(n, 2 * width)``."""
        edges = self.edges(features, graph)
        return pools(edges, [len(edges)])
