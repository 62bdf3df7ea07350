# SPDX-License-Identifier: Apache-2.0
"""Hierarchical feature learning and recalibration of PUGeo-Net (Qian et al. 2020, section 3.2).

A 3x3 input transform (STN-like), EdgeConv levels on dynamic graphs, a fused level with its maximum
over the patch, and softmax weights over all levels.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones.edge_conv import EdgeConv, PointMLP, knn_graph

__all__ = ["DGCNN", "InputTransform"]


class InputTransform(nn.Module):
    """STN-like network: one 3x3 matrix ``A`` for a patch, applied to all of its points.

    The last layer starts at zero and the identity is added, so training starts from ``A = I``.

    Args:
        k: neighbours of the graph.
        norm: batch norm after every layer but the last.
    """

    def __init__(self, k: int, *, norm: bool) -> None:
        super().__init__()
        self.k = k
        self.edge = EdgeConv(3, 64, norm=norm)
        self.points = nn.Sequential(PointMLP(128, 128, norm=norm), PointMLP(128, 1024, norm=norm))
        self.patch = nn.Sequential(PointMLP(1024, 512, norm=norm), PointMLP(512, 256, norm=norm))
        self.out = nn.Linear(256, 9)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, points: Tensor) -> Tensor:
        """``(B, N, 3)`` -> ``(B, 3, 3)``."""
        batch, count, _ = points.shape
        pooled = self.edge(points.flatten(0, 1), knn_graph(points, self.k))
        each = self.points(pooled).unflatten(0, (batch, count))
        out: Tensor = self.out(self.patch(each.amax(dim=1))).unflatten(-1, (3, 3))
        identity = torch.eye(3, dtype=out.dtype)
        return identity + out


class DGCNN(nn.Module):
    """Per-point features ``c_i``.

    Level ``l`` gives the maximum and the mean of its 64-channel edge features and a 64-channel
    point feature; its graph is built in the point features of the level before. A fused level of
    1024 channels and its maximum over the patch close the list. All parts are the ``c_i^l`` of the
    paper's equations 1 to 3:

    ``a_i = h_r(Concat(c_i^1, ..., c_i^L))``, ``w_i = softmax(a_i)``,
    ``c_i = Concat(w_i^1 c_i^1, ..., w_i^L c_i^L)``.

    The paper prints the factor of the last level as ``a_hat_i^L``; it is ``w_i^L`` here, as for
    the other levels. The concatenation enters one layer of ``features`` channels.

    The maximum over the patch is the same for all N points: its products are made once a patch.

    Args:
        features: channels out.
        k: neighbours of the graphs.
        width: channels of edges and points of a level.
        levels: EdgeConv levels.
        fused: channels of the fused level.
        recalibrate: weigh the levels; plain concatenation otherwise (ablation, Table 3).
        transform: learn the input transform.
        norm: batch norm after every layer.
    """

    def __init__(
        self,
        features: int,
        *,
        k: int = 30,
        width: int = 64,
        levels: int = 3,
        fused: int = 1024,
        recalibrate: bool = True,
        transform: bool = True,
        norm: bool = True,
    ) -> None:
        super().__init__()
        self.k = k
        self.transform = InputTransform(k, norm=norm) if transform else None
        self.edge_convs = nn.ModuleList(
            EdgeConv(width if level else 3, width, 1 if level else 2, norm=norm)
            for level in range(levels)
        )
        self.point_layers = nn.ModuleList(
            PointMLP(2 * width, width, norm=norm) for _ in range(levels)
        )
        self.fuse = PointMLP(levels * width, fused, norm=norm)
        self.sizes = [*[width] * (3 * levels), fused, fused]
        total = sum(self.sizes)
        self.logits: nn.ModuleList | None = None
        if recalibrate:
            self.logits = nn.ModuleList(
                [
                    nn.Linear(total, 128),
                    PointMLP(128, 64, norm=norm),
                    nn.Linear(64, len(self.sizes)),
                ]
            )
        self.out = nn.Linear(total, features)
        nn.init.kaiming_normal_(self.out.weight, nonlinearity="relu")
        nn.init.zeros_(self.out.bias)
        self.norm = nn.BatchNorm1d(features) if norm else nn.Identity()

    def forward(self, points: Tensor) -> Tensor:
        """``(B, N, 3)`` float32 -> features ``(B, N, features)``."""
        batch, count, _ = points.shape
        if self.transform is not None:
            points = points @ self.transform(points)
        parts, outs = [], []
        level = points.flatten(0, 1)
        for edge_conv, layer in zip(self.edge_convs, self.point_layers, strict=True):
            pooled = edge_conv(level, knn_graph(level.unflatten(0, (batch, count)), self.k))
            level = layer(pooled)
            parts.append(torch.cat([pooled, level], dim=-1))
            outs.append(level)
        fused = self.fuse(torch.cat(outs, dim=-1))
        patch = fused.unflatten(0, (batch, count)).amax(dim=1)
        each = torch.cat([*parts, fused], dim=-1)
        weights = self.weights(each, patch)
        if weights is not None:
            sizes = torch.tensor(self.sizes[:-1])
            each = each * weights[:, :-1].repeat_interleave(sizes, dim=1)
        own, shared = self._split(self.out.weight)
        common = functional.linear(patch, shared).repeat_interleave(count, dim=0)
        if weights is not None:
            common = common * weights[:, -1:]
        out = functional.linear(each, own, self.out.bias) + common
        features: Tensor = functional.relu(self.norm(out)).unflatten(0, (batch, count))
        return features

    def weights(self, each: Tensor, patch: Tensor) -> Tensor | None:
        """Softmax weights of the levels, ``(B * N, levels)``; ``None`` without recalibration.

        Their sum is the number of levels and not 1, so that the features keep their size.

        Args:
            each: ``(B * N, F')`` all levels but the last.
            patch: ``(B, fused)`` the last level.
        """
        if self.logits is None:
            return None
        first, second, last = self.logits
        assert isinstance(first, nn.Linear)
        own, shared = self._split(first.weight)
        common = functional.linear(patch, shared).repeat_interleave(len(each) // len(patch), dim=0)
        hidden = functional.relu(functional.linear(each, own, first.bias) + common)
        return functional.softmax(last(second(hidden)), dim=-1) * len(self.sizes)

    def _split(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Columns of a layer that read what differs from point to point, and the rest."""
        own, shared = weight.split([sum(self.sizes[:-1]), self.sizes[-1]], dim=1)
        return own, shared
