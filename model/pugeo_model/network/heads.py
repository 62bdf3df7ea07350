# SPDX-License-Identifier: Apache-2.0
"""The four heads of PUGeo-Net: f1 (u, v), f2 matrix T, f3 displacement, f4 normal.

Lengths are in local spacings; ``T`` is relative to the canonical frame. Output layers start near
zero, so that training starts from the quadric fit.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.geometry.quadric import QUADRIC
from pugeo_model.network.kernels.pooling import rectify
from pugeo_model.network.linear import Linear, Rectified
from pugeo_model.network.pattern import DISK_SIDE, disk
from pugeo_model.network.precision import wide_products

__all__ = ["LOG_ERROR", "Frame", "Samples", "SurfaceHead", "combine", "quadric"]

LOG_ERROR = -3.0
"""Log of the error, in spacings, that an untrained head predicts."""

_TERMS = 8  # u, v, u^2, u v, v^2, quadric height and its two slopes


def _near_zero(layer: Linear) -> Linear:
    """Initialise an output layer near zero."""
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.zero_()
    return layer


def combine(uv: Tensor, basis: Tensor) -> Tensor:
    """Compute ``u b_1 + v b_2``; a matrix product with an inner dimension of 2 is slow.

    Args:
        uv: ``(n, r, 2)`` or ``(r, 2)``.
        basis: ``(n, 2, d)``.

    Returns:
        ``(n, r, d)``.
    """
    along, across = basis.unsqueeze(2).unbind(1)
    u, v = uv.unsqueeze(-1).unbind(-2)
    return torch.addcmul(u * along, v, across)


def quadric(coefficients: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluate height and slopes of the fitted quadric, without its constant.

    Args:
        coefficients: ``(n, 1, 6)``.
        uv: ``(n, r, 2)``.

    Returns:
        Height ``(n, r)`` and slopes ``(n, r, 2)``.
    """
    u, v = uv.unbind(-1)
    _, c1, c2, c3, c4, c5 = coefficients.unbind(-1)
    height = c1 * u + c2 * v + 0.5 * c3 * u * u + c4 * u * v + 0.5 * c5 * v * v
    return height, torch.stack([c1 + c3 * u + c4 * v, c2 + c4 * u + c5 * v], dim=-1)


class Frame(nn.Module):
    """f2: features to the augmented Jacobian ``T = [Phi_u, Phi_v, Phi_u x Phi_v]`` (eq. 5).

    ``T`` is orthonormal (Gram-Schmidt of identity plus residual). The scale and rotation of a free
    3x3 matrix are ambiguous with those of (u, v): in training T shrank and T^-1 diverged.

    Args:
        features: channels of the input.
        learned: predict T; it is the canonical frame otherwise (ablation of Table 3).
    """

    def __init__(self, features: int, *, learned: bool = True) -> None:
        super().__init__()
        self.out = _near_zero(Linear(features, 6)) if learned else None
        self.register_buffer("identity", torch.eye(3)[:2].flatten(), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """``(n, features)`` -> ``(n, 3, 3)``; columns are the two tangents and the normal."""
        if self.out is None:
            return torch.eye(3).expand(len(features), 3, 3)
        with wide_products():
            out = self.out(features).float()
        first, second = (out + self.identity).unflatten(-1, (2, 3)).unbind(1)
        t1 = functional.normalize(first, dim=-1)
        t2 = functional.normalize(second - (second * t1).sum(-1, keepdim=True) * t1, dim=-1)
        return torch.stack([t1, t2, torch.linalg.cross(t1, t2)], dim=-1)


class Samples(nn.Module):
    """f1: features to adaptive samples (u, v) (eq. 3), for any number of samples.

    An even disk pattern times a learned 2x2 matrix, plus a learned residual. The input of the
    residual includes the pattern point, its radius and ``R^-1/2``, so that one set of weights
    works at any ratio R.

    Args:
        features: channels of the input.
        width: hidden channels.
        learned: adapt the pattern; it is the same for all charts otherwise (ablation of Table 3).
    """

    def __init__(self, features: int, width: int, *, learned: bool = True) -> None:
        super().__init__()
        self.learned = learned
        if not learned:
            return
        self.stretch = _near_zero(Linear(features, 4))
        self.code = Linear(features, width)
        self.pattern = Linear(4, width, bias=False)
        self.hidden = Rectified(width, width)
        self.out = _near_zero(Linear(width, 2))
        self.register_buffer("identity", torch.eye(2).flatten(), persistent=False)

    def forward(self, features: Tensor, count: int) -> Tensor:
        """``(n, features)`` -> ``(n, count, 2)`` in spacings."""
        pattern = torch.from_numpy(disk(count))
        if not self.learned:
            fixed: Tensor = (DISK_SIDE * pattern).expand(len(features), -1, -1)
            return fixed
        inverse_root = count**-0.5
        position = torch.cat(
            [
                pattern,
                pattern.norm(dim=-1, keepdim=True),
                torch.full((count, 1), inverse_root),
            ],
            dim=-1,
        )
        with wide_products():
            stretch = (self.stretch(features).float() + self.identity).unflatten(-1, (2, 2))
            hidden = rectify(self.code(features).unsqueeze(1) + self.pattern(position))
            hidden = self.hidden(hidden)
            residual = 2.0 * inverse_root * self.out(hidden).float()
        uv: Tensor = DISK_SIDE * (combine(pattern, stretch.mT) + residual)
        return uv


class SurfaceHead(nn.Module):
    """f3 and f4: displacement along the normal (eq. 7) and normal offset (eq. 8) at any (u, v).

    It also predicts the log of its own error, which weights charts and candidates.

    Args:
        features: channels of the input.
        width: channels of the first layer.
        hidden: channels of the second layer.
    """

    def __init__(self, features: int, width: int, hidden: int) -> None:
        super().__init__()
        self.width = width
        self.code = Linear(features, width)
        self.terms = Linear(_TERMS, width, bias=False)
        self.hidden = Rectified(width, hidden)
        self.out = _near_zero(Linear(hidden, 4))
        self.lift = _near_zero(Linear(features, 2))

    def encode(self, features: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the values of a chart that all its samples share.

        The lift is an offset of the whole chart along its normal: a learned fraction of the
        quadric's constant (1 for noisy input, 0 if the point is on the surface), plus a free part.

        Args:
            features: ``(n, features)``.
            coefficients: ``(n, 6)`` float32 quadric.

        Returns:
            Code ``(n, width)`` and lift ``(n,)`` in spacings.
        """
        with wide_products():
            fraction, free = self.lift(features).float().unbind(-1)
            code = self.code(features)
        return code, (0.5 + fraction) * coefficients[:, 0] + free

    def forward(
        self, code: Tensor, lift: Tensor, coefficients: Tensor, uv: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate charts.

        Args:
            code: ``(n, width)``.
            lift: ``(n,)`` float32.
            coefficients: ``(n, 6)`` float32 quadric.
            uv: ``(n, r, 2)`` float32.

        Returns:
            Displacement ``(n, r)``, unit normals in the frame of T ``(n, r, 3)``, and the log of
            the predicted error in spacings ``(n, r)``; all float32.
        """
        assert coefficients.shape[-1] == QUADRIC
        height, slope = quadric(coefficients.unsqueeze(1), uv)
        u, v = uv.unbind(-1)
        terms = torch.stack([u, v, u * u, u * v, v * v, height, *slope.unbind(-1)], dim=-1)
        with wide_products():
            hidden = rectify(self.terms(terms).add_(code.unsqueeze(1)))
            out = self.out(self.hidden(hidden)).float()
        displacement = height + lift.unsqueeze(1) + out[..., 0]
        up = torch.ones_like(displacement)
        normal = torch.stack([out[..., 1] - slope[..., 0], out[..., 2] - slope[..., 1], up], dim=-1)
        return displacement, functional.normalize(normal, dim=-1), out[..., 3] + LOG_ERROR
