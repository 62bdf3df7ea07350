# SPDX-License-Identifier: Apache-2.0
"""PUGeo-Net as published (Qian, Hou, Kwong, He, ECCV 2020), for one ratio R."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones.dgcnn import DGCNN
from pugeo_model.network.backbones.edge_conv import PointMLP
from pugeo_model.network.patch_networks.output import LocalGeometry, PatchOutput
from pugeo_model.network.pattern import disk

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
        return axes.to(points.dtype)


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
        out = self.out(self.hidden(functional.relu(self.norm(mixed))))
        return out.unflatten(0, samples.shape[:2])


class PUGeoNetPaper(nn.Module):
    """The network of the paper: features, parameterization, expansion, local shape.

    With ``c_i`` from :class:`DGCNN`:

    - f1: ``{(u_i^r, v_i^r)} = f1(c_i)``, R pairs (eq. 4)
    - f2: ``T_i = f2(c_i)``, a free 3x3 matrix (eq. 5)
    - ``x_hat_i^r = T_i (u, v, 0) + x_i`` (eq. 6) and ``n_i = T_i (0, 0, 1)`` (eq. 7)
    - f3: ``delta = f3(x_hat, c_i)`` and ``x_i^r = x_hat + T_i (0, 0, delta)`` (eq. 8, 9)
    - f4: ``n_i^r = n_i + f4(x_hat, c_i)`` (eq. 10, 11)

    Normals are divided by their length, the coarse one before the offset is added.

    Args:
        ratio: R; the network is for this ratio alone.
        features: channels of ``c_i``.
        head: hidden channels of f3 and f4.
        align: turn every patch into its principal axes before the network, and the result back. The
            paper leaves rotations to the input transform and augmentation alone.
        quiet: start the heads near ``T = I``, an even disk of (u, v) and no offsets, in the place
            of random values. The paper does not say how it starts.
        learned_uv: f1 is learned; a fixed regular grid otherwise (Table 3).
        linear_map: f2 is learned; otherwise MLPs give coordinates and normals directly (Table 3).
        coarse_to_fine: f3 and f4 refine; otherwise f1 and f2 regress the final points through
            offsets without the intermediate loss (Table 3).
        normals: predict normals (Table 3).
        **backbone: arguments of :class:`DGCNN`.
    """

    def __init__(
        self,
        ratio: int,
        *,
        features: int = 256,
        head: int = 128,
        align: bool = True,
        quiet: bool = True,
        norm: bool = True,
        **backbone: int,
    ) -> None:
        super().__init__()
        self.ratio, self.align = ratio, align
        self.backbone = DGCNN(features, norm=norm, **backbone)  # type: ignore[arg-type]
        self.uv = nn.Linear(features, 2 * ratio)
        self.T = nn.Linear(features, 9)
        self.displacement = SampleMLP(features, head, 1, norm=norm)
        self.normal_offset = SampleMLP(features, head, 3, norm=norm)
        if quiet:
            self._quiet()

    def _quiet(self) -> None:
        """Start from the identity, an even disk and no offsets."""
        with torch.no_grad():
            for layer in (self.uv, self.T, self.displacement.out, self.normal_offset.out):
                layer.weight.mul_(0.01)
                layer.bias.zero_()
            self.T.bias.copy_(torch.eye(3).flatten())
            self.uv.bias.copy_(torch.from_numpy(disk(self.ratio)).flatten())

    def forward(self, points: Tensor) -> PatchOutput:
        """``(B, N, 3)`` float32, each patch centred and of radius 1."""
        if not self.align:
            return self._upsample(points)
        axes = principal_axes(points)
        return self._upsample(points @ axes.mT).turned(axes)

    def _upsample(self, points: Tensor) -> PatchOutput:
        batch, count, _ = points.shape
        features = self.backbone(points).flatten(0, 1)
        flat = points.reshape(-1, 1, 3)
        spacing = (_AREA / count) ** 0.5
        uv = spacing * self.uv(features).unflatten(-1, (self.ratio, 2))
        T = self.T(features).unflatten(-1, (3, 3))
        tangent_points = flat + uv @ T[..., :2].mT
        coarse = functional.normalize(T[..., 2], dim=-1)
        delta = spacing * self.displacement(tangent_points, features)
        moved = tangent_points + delta * T[:, None, :, 2]
        offset = self.normal_offset(tangent_points, features)
        normals = functional.normalize(coarse.unsqueeze(1) + offset, dim=-1)

        def shaped(values: Tensor) -> Tensor:
            return values.unflatten(0, (batch, count))

        return PatchOutput(
            shaped(moved),
            shaped(normals),
            shaped(coarse),
            LocalGeometry(shaped(uv), shaped(T), shaped(delta.squeeze(-1))),
        )
