# SPDX-License-Identifier: Apache-2.0
"""PUGeo-Net as published (Qian, Hou, Kwong, He, ECCV 2020), for one ratio R."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones.dgcnn import DGCNN
from pugeo_model.network.backbones.edge_conv import PointMLP
from pugeo_model.network.patch_networks.output import LocalGeometry, PatchOutput
from pugeo_model.network.pattern import disk, regular_grid

__all__ = ["PUGeoNetPaper", "SampleMLP", "principal_axes"]

_AREA = 3.0  # of a patch of radius 1, about pi for a disk: gives the unit of (u, v)


def principal_axes(points: Tensor) -> Tensor:
    """Right-handed principal axes of patches, rows by falling variance: the last is the normal's.

    Args:
        points: ``(B, N, 3)`` centred.

    Returns:
        ``(B, 3, 3)`` rotations without gradient.
    """
    with torch.no_grad():
        centred = points.double()
        _, vectors = torch.linalg.eigh(centred.mT @ centred)
        axes = vectors.mT.flip(1)
        axes[:, 2] = torch.linalg.cross(axes[:, 0], axes[:, 1])
        rotations: Tensor = axes.to(points.dtype)
        return rotations


class SampleMLP(nn.Module):
    """f3 and f4: an MLP on ``Concat(x_hat_i^r, c_i)`` (eq. 7 and 9).

    ``c_i`` is the same for the R samples of a point: its product is made once a point.

    Args:
        features: channels of ``c_i``.
        width: hidden channels.
        outputs: channels out.
        norm: batch norm in the hidden layers.
    """

    def __init__(self, features: int, width: int, outputs: int, *, norm: bool) -> None:
        super().__init__()
        self.code = nn.Linear(features, width)
        self.position = nn.Linear(3, width, bias=False)
        self.norm = nn.BatchNorm1d(width) if norm else nn.Identity()
        self.hidden = PointMLP(width, width, norm=norm)
        self.out = nn.Linear(width, outputs)

    def forward(self, samples: Tensor, features: Tensor) -> Tensor:
        """``(n, R, 3)`` and ``(n, features)`` -> ``(n, R, outputs)``."""
        mixed = (self.position(samples) + self.code(features).unsqueeze(1)).flatten(0, 1)
        hidden = self.hidden(functional.relu(self.norm(mixed)))
        out: Tensor = self.out(hidden).unflatten(0, samples.shape[:2])
        return out


class PUGeoNetPaper(nn.Module):
    """The network of the paper: features, parameterization, expansion, local shape.

    With ``c_i`` from :class:`DGCNN`:

    - f1: ``{(u_i^r, v_i^r)} = f1(c_i)``, R pairs (eq. 4)
    - f2: ``T_i = f2(c_i)``, a free 3x3 matrix (eq. 5)
    - ``x_hat_i^r = T_i (u, v, 0) + x_i`` (eq. 6) and ``n_i = T_i (0, 0, 1)`` (eq. 7)
    - f3: ``delta = f3(x_hat, c_i)`` and ``x_i^r = x_hat + T_i (0, 0, delta)`` (eq. 8, 9)
    - f4: ``n_i^r = n_i + f4(x_hat, c_i)`` (eq. 10, 11)

    Normals are divided by their length, the coarse one before the offset is added. Outputs of f1
    and f3 are in units of the mean spacing of a patch's points.

    The last four arguments are the ablations of Table 3; a fifth, feature recalibration, is
    ``recalibrate`` of :class:`DGCNN`.

    Args:
        ratio: R; the network is for this ratio alone.
        features: channels of ``c_i``.
        head: hidden channels of f3 and f4.
        align: turn every patch into its principal axes before the network, and the result back. The
            paper leaves rotations to the input transform and augmentation alone.
        quiet: start the heads near ``T = I``, an even disk of (u, v) and no offsets, in the place
            of random values. The paper does not say how it starts.
        norm: batch norm in all hidden layers.
        normals: predict normals; coordinates alone otherwise.
        adaptive_uv: learn f1; a fixed regular grid of (u, v) otherwise.
        linear_map: lift (u, v) by ``T``; otherwise MLPs on ``(u, v)`` and ``c_i`` give coordinates
            and normals directly, and there is no coarse normal.
        coarse_to_fine: refine tangent points and coarse normals by f3 and f4; otherwise ``delta``
            and the normals are linear in ``c_i`` too, and there is no coarse normal.
        **backbone: arguments of :class:`DGCNN`.
    """

    grid: Tensor

    def __init__(
        self,
        ratio: int,
        *,
        features: int = 256,
        head: int = 128,
        align: bool = True,
        quiet: bool = True,
        norm: bool = True,
        normals: bool = True,
        adaptive_uv: bool = True,
        linear_map: bool = True,
        coarse_to_fine: bool = True,
        **backbone: int,
    ) -> None:
        super().__init__()
        if not linear_map and not coarse_to_fine:
            raise ValueError("linear_map and coarse_to_fine cannot both be left out")
        self.ratio, self.align = ratio, align
        self.backbone = DGCNN(features, norm=norm, **backbone)  # type: ignore[arg-type]
        self.uv = nn.Linear(features, 2 * ratio) if adaptive_uv else None
        self.register_buffer("grid", torch.from_numpy(regular_grid(ratio)), persistent=False)
        self.T = nn.Linear(features, 9) if linear_map else None
        outputs = 1 if linear_map else 3
        self.displacement: Any = (
            SampleMLP(features, head, outputs, norm=norm)
            if coarse_to_fine
            else nn.Linear(features, ratio)
        )
        self.normal_offset: Any = None
        if normals:
            self.normal_offset = (
                SampleMLP(features, head, 3, norm=norm)
                if coarse_to_fine
                else nn.Linear(features, 3 * ratio)
            )
        if quiet:
            self._quiet()

    def _quiet(self) -> None:
        """Start from the identity, an even disk and no offsets."""
        heads = [self.uv, self.T, self.displacement, self.normal_offset]
        with torch.no_grad():
            for head in heads:
                layer = head.out if isinstance(head, SampleMLP) else head
                if layer is not None:
                    layer.weight.mul_(0.01)
                    layer.bias.zero_()
            if self.T is not None:
                self.T.bias.copy_(torch.eye(3).flatten())
            if self.uv is not None:
                self.uv.bias.copy_(torch.from_numpy(disk(self.ratio)).flatten())
            direct_normals = self.T is None or isinstance(self.normal_offset, nn.Linear)
            if self.normal_offset is not None and direct_normals:
                layer = self.normal_offset
                layer = layer.out if isinstance(layer, SampleMLP) else layer
                layer.bias.view(-1, 3)[:, 2] = 1.0

    def forward(self, points: Tensor) -> PatchOutput:
        """``(B, N, 3)`` float32, each patch centred and of radius 1."""
        if not self.align:
            return self._upsample(points)
        axes = principal_axes(points)
        return self._upsample(points @ axes.mT).turned(axes)

    def _upsample(self, points: Tensor) -> PatchOutput:
        batch, count, _ = points.shape
        features = self.backbone(points).flatten(0, 1)
        spacing = (_AREA / count) ** 0.5
        if self.uv is None:
            uv = self.grid.expand(len(features), -1, -1)
        else:
            uv = self.uv(features).unflatten(-1, (self.ratio, 2))
        make = self._directly if self.T is None else self._on_charts
        output = make(points.reshape(-1, 1, 3), features, uv, spacing)
        return output.unflatten(batch, count)

    def _directly(
        self, points: Tensor, features: Tensor, uv: Tensor, spacing: float
    ) -> PatchOutput:
        """Points and normals by MLPs on (u, v) and the features, without ``T``."""
        place = functional.pad(uv, (0, 1))
        moved = points + spacing * (place + self.displacement(place, features))
        if self.normal_offset is None:
            return PatchOutput(moved)
        normals = self.normal_offset(place, features)
        return PatchOutput(moved, functional.normalize(normals, dim=-1))

    def _on_charts(
        self, points: Tensor, features: Tensor, uv: Tensor, spacing: float
    ) -> PatchOutput:
        """Equations 4 to 11 for ``n`` points ``(n, 1, 3)``."""
        assert self.T is not None
        uv = spacing * uv
        T = self.T(features).unflatten(-1, (3, 3))
        tangent_points = points + uv @ T[..., :2].mT
        if isinstance(self.displacement, SampleMLP):
            delta = spacing * self.displacement(tangent_points, features).squeeze(-1)
        else:
            delta = spacing * self.displacement(features)
        moved = tangent_points + delta.unsqueeze(-1) * T[:, None, :, 2]
        geometry = LocalGeometry(uv, T, delta)
        if self.normal_offset is None:
            return PatchOutput(moved, geometry=geometry)
        if not isinstance(self.normal_offset, SampleMLP):
            normals = self.normal_offset(features).unflatten(-1, (self.ratio, 3))
            return PatchOutput(moved, functional.normalize(normals, dim=-1), geometry=geometry)
        coarse = functional.normalize(T[..., 2], dim=-1)
        offset = self.normal_offset(tangent_points, features)
        normals = functional.normalize(coarse.unsqueeze(1) + offset, dim=-1)
        return PatchOutput(moved, normals, coarse, geometry)
