# SPDX-License-Identifier: Apache-2.0
"""PU-Net (Yu et al. 2018), and PU-Net-M, which predicts normals too (Qian et al., section 4.3)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones.edge_conv import PointMLP
from pugeo_model.network.backbones.pointnet2 import PointNet2
from pugeo_model.network.patch_networks.output import PatchOutput

__all__ = ["PUNet"]


class PUNet(nn.Module):
    """Features of a point, expanded by R independent branches, regressed to coordinates.

    ``f_i^r = C2_r(C1_r(f_i))`` with own weights in every branch r (section 3.3 there), then a
    shared MLP gives coordinates. Its size grows with R.

    Args:
        ratio: R.
        features: channels of a branch's first layer.
        head: channels of its second layer.
        normals: PU-Net-M: the last layer has 6 channels in the place of 3.
        residual: coordinates are those of the input point plus the output. PU-Net regresses
            coordinates themselves, which takes far longer to learn.
        norm: batch norm in the hidden layers.
    """

    def __init__(
        self,
        ratio: int,
        *,
        features: int = 256,
        head: int = 128,
        normals: bool = False,
        residual: bool = True,
        norm: bool = True,
    ) -> None:
        super().__init__()
        self.ratio, self.residual = ratio, residual
        self.backbone = PointNet2(norm=norm)
        self.branches = nn.ModuleList(
            nn.Sequential(
                PointMLP(self.backbone.features, features, norm=norm),
                PointMLP(features, head, norm=norm),
            )
            for _ in range(ratio)
        )
        self.hidden = PointMLP(head, 64, norm=norm)
        self.out = nn.Linear(64, 6 if normals else 3)

    def forward(self, points: Tensor) -> PatchOutput:
        """``(B, N, 3)`` float32, each patch centred and of radius 1."""
        batch, count, _ = points.shape
        features = self.backbone(points).flatten(0, 1)
        expanded = torch.stack([branch(features) for branch in self.branches], dim=1)
        out = self.out(self.hidden(expanded.flatten(0, 1)))
        out = out.unflatten(0, (batch, count, self.ratio))
        coordinates = out[..., :3]
        if self.residual:
            coordinates = points.unsqueeze(2) + coordinates
        if out.shape[-1] == 3:
            return PatchOutput(coordinates)
        return PatchOutput(coordinates, functional.normalize(out[..., 3:], dim=-1))
