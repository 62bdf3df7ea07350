# SPDX-License-Identifier: Apache-2.0
"""Multi-scale features of PU-Net: PointNet++ set abstraction, interpolated to all points.

Yu et al., PU-Net (2018), section 3.2; Qi et al., PointNet++ (2017).
"""

import itertools

import numpy as np
import torch
from torch import Tensor, nn

from pugeo_model.geometry.farthest import farthest_points
from pugeo_model.network.backbones.edge_conv import PointMLP

__all__ = ["PointNet2", "SetAbstraction", "interpolate"]

_GROUP = 32  # points of a ball at most
# Channels of the shared MLPs, ball radii, and the share of points kept, level by level. PU-Net's
# radii .05 to .3 are for patches of 1,024 points; 256 lie twice as far apart.
_LEVELS = (
    ((32, 32, 64), 0.1, 1),
    ((64, 64, 128), 0.2, 2),
    ((128, 128, 256), 0.4, 4),
    ((256, 256, 512), 0.6, 8),
)


class SetAbstraction(nn.Module):
    """One level: balls around farthest points, a shared MLP on each ball, its maximum.

    Args:
        inputs: channels of the points.
        widths: channels of the MLP.
        radius: of the balls.
        norm: batch norm after every layer.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...], radius: float, *, norm: bool) -> None:
        super().__init__()
        self.radius = radius
        sizes = (3 + inputs, *widths)
        self.mlp = nn.Sequential(*(PointMLP(a, b, norm=norm) for a, b in itertools.pairwise(sizes)))

    def forward(self, points: Tensor, features: Tensor, centres: Tensor) -> Tensor:
        """Features of the centres.

        Args:
            points: ``(B, n, 3)``.
            features: ``(B, n, C)``; ``C`` may be 0.
            centres: ``(B, m, 3)``, a subset of the points.

        Returns:
            ``(B, m, widths[-1])``.
        """
        with torch.no_grad():
            apart = torch.cdist(centres, points)
            distance, rows = apart.topk(min(_GROUP, points.shape[1]), dim=-1, largest=False)
            # As PointNet++ fills up balls with few points: by the centre itself.
            rows = torch.where(distance <= self.radius, rows, rows[..., :1])
        local = _take(points, rows) - centres.unsqueeze(2)
        grouped = torch.cat([local, _take(features, rows)], dim=-1)
        each: Tensor = self.mlp(grouped.flatten(0, 2)).unflatten(0, grouped.shape[:3])
        return each.amax(dim=2)


def _take(values: Tensor, rows: Tensor) -> Tensor:
    """``(B, n, C)`` at rows ``(B, m, k)`` -> ``(B, m, k, C)``."""
    flat = rows.flatten(1).unsqueeze(-1).expand(-1, -1, values.shape[-1])
    taken: Tensor = values.gather(1, flat).unflatten(1, rows.shape[1:])
    return taken


def interpolate(points: Tensor, centres: Tensor, features: Tensor) -> Tensor:
    """Inverse-distance mean of the three nearest centres (PointNet++, eq. 2).

    Args:
        points: ``(B, n, 3)``.
        centres: ``(B, m, 3)``.
        features: ``(B, m, C)``.

    Returns:
        ``(B, n, C)``.
    """
    distance, rows = torch.cdist(points, centres).topk(3, dim=-1, largest=False)
    weights = 1.0 / (distance.square() + 1e-8)
    weights = weights / weights.sum(-1, keepdim=True)
    return (_take(features, rows) * weights.unsqueeze(-1)).sum(dim=2)


class PointNet2(nn.Module):
    """Features of all points from four scales: ``(B, N, 3)`` -> ``(B, N, features)``.

    Args:
        norm: batch norm after every layer.
    """

    def __init__(self, *, norm: bool) -> None:
        super().__init__()
        inputs = [0, *(widths[-1] for widths, _, _ in _LEVELS)]
        self.levels = nn.ModuleList(
            SetAbstraction(c, widths, radius, norm=norm)
            for c, (widths, radius, _) in zip(inputs, _LEVELS, strict=False)
        )
        # Every coarser level enters with 64 channels.
        self.reduce = nn.ModuleList(PointMLP(c, 64, norm=norm) for c in inputs[2:])
        self.features = 3 + inputs[1] + 64 * (len(_LEVELS) - 1)

    def forward(self, points: Tensor) -> Tensor:
        """Concatenate coordinates, the finest level and the reduced coarser ones."""
        count = points.shape[1]
        order = _farthest(points, count // _LEVELS[1][2])
        at, features = points, points[..., :0]
        parts = [points]
        for number, (level, (_, _, share)) in enumerate(zip(self.levels, _LEVELS, strict=True)):
            rows = order[:, : count // share].unsqueeze(-1).expand(-1, -1, 3)
            centres = points if share == 1 else points.gather(1, rows)
            features = level(at, features, centres)
            at = centres
            if number == 0:
                parts.append(features)
                continue
            spread = interpolate(points, centres, features)
            reduced = self.reduce[number - 1](spread.flatten(0, 1))
            parts.append(reduced.unflatten(0, spread.shape[:2]))
        return torch.cat(parts, dim=-1)


def _farthest(points: Tensor, count: int) -> Tensor:
    """Farthest points of each patch in order, ``(B, count)`` int64."""
    clouds = points.detach().double().numpy()
    return torch.from_numpy(np.stack([farthest_points(cloud, count) for cloud in clouds]))
