# SPDX-License-Identifier: Apache-2.0
"""MPU (Wang et al. 2019, "Patch-based progressive 3D point set upsampling"): 2x after 2x."""

from typing import cast

import torch
from torch import Tensor, nn

from pugeo_model.network.backbones.dense_edge_conv import DenseFeatures
from pugeo_model.network.backbones.edge_conv import PointMLP
from pugeo_model.network.backbones.pointnet2 import interpolate
from pugeo_model.network.patch_networks.output import PatchOutput

__all__ = ["MPU", "MPUUnit"]


class MPUUnit(nn.Module):
    """One level: features, replication told apart by a code of -1 and 1, residual coordinates.

    Features of the level before are interpolated to the points and added (the paper's skip
    connection between levels; there their weights also depend on the features).

    Args:
        growth: channels of the edge layers.
        head: channels of the reduced features and of the regression.
        first: no level before.
    """

    def __init__(self, growth: int, head: int, *, first: bool) -> None:
        super().__init__()
        self.backbone = DenseFeatures(growth=growth)
        self.reduce = PointMLP(self.backbone.features, head, norm=False)
        self.skip = None if first else PointMLP(head, head, norm=False)
        self.code = nn.Linear(head, head)
        self.side = nn.Linear(1, head, bias=False)
        self.hidden = PointMLP(head, head // 2, norm=False)
        self.out = nn.Linear(head // 2, 3)
        # The two copies of a point would be one for a long time, since all samples start alike.
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            self.out.bias.zero_()

    def forward(
        self, points: Tensor, before: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor]:
        """Upsample by 2.

        Args:
            points: ``(B, N, 3)``.
            before: points ``(B, N / 2, 3)`` and features ``(B, N / 2, head)`` of the level before.

        Returns:
            Points ``(B, 2 N, 3)``, the two of a point side by side, and features ``(B, N, head)``.
        """
        known = self.backbone(points)
        features = self.reduce(known.flatten(0, 1)).unflatten(0, known.shape[:2])
        if self.skip is not None:
            assert before is not None
            passed = interpolate(points, *before)
            features = features + self.skip(passed.flatten(0, 1)).unflatten(0, known.shape[:2])
        sides = self.side(torch.tensor([[-1.0], [1.0]]))
        copies = torch.relu(self.code(features).unsqueeze(2) + sides)
        offset = self.out(self.hidden(copies.flatten(0, 2))).unflatten(0, copies.shape[:3])
        return (points.unsqueeze(2) + offset).flatten(1, 2), features


class MPU(nn.Module):
    """A cascade of :class:`MPUUnit`, each with own weights.

    All levels are trained at once and on whole patches; the paper trains level by level, on crops
    of the points of the level before.

    Args:
        ratio: R, a power of 2.
        features: channels of the units' features.
        head: as ``features``; kept for the form of a recipe.
        growth: channels of the edge layers.

    Raises:
        ValueError: R is no power of 2: the cascade cannot make it.
    """

    def __init__(
        self, ratio: int, *, features: int = 128, head: int = 128, growth: int = 24
    ) -> None:
        super().__init__()
        levels = ratio.bit_length() - 1
        if ratio < 2 or ratio != 1 << levels:
            raise ValueError(f"MPU upsamples by powers of 2, not by {ratio}")
        if features != head:
            raise ValueError("MPU has one width: give features and head alike")
        self.ratio = ratio
        self.units = nn.ModuleList(
            MPUUnit(growth, features, first=level == 0) for level in range(levels)
        )

    def forward(self, points: Tensor) -> PatchOutput:
        """``(B, N, 3)`` float32, each patch centred and of radius 1."""
        at, before = points, None
        for unit in self.units:
            dense, features = cast(tuple[Tensor, Tensor], unit(at, before))
            at, before = dense, (at, features)
        # The samples of a point lie side by side after every doubling.
        return PatchOutput(at.unflatten(1, (points.shape[1], self.ratio)))
