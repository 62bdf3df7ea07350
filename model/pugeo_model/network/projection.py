# SPDX-License-Identifier: Apache-2.0
"""Landing a location on the nearest charts and blending what they say.

A chart is trusted by distance and by the error it predicts for itself: near a crease or over a
thin wall the chart of the other side expects to be wrong and loses its say.
"""

import torch
from torch import Tensor
from torch.nn import functional

from pugeo_model.network.heads import Surface
from pugeo_model.network.pugeo import Charts, evaluate

__all__ = ["FALLOFF", "TRUST", "blend", "parametrise"]

FALLOFF = 2.0
"""Of the blending weight with the squared distance in spacings."""

TRUST = 2.0
"""Power of the inverse expected error: inverse variance."""


def parametrise(charts: Charts, offsets: Tensor) -> Tensor:
    """(u, v) of locations in their charts.

    Args:
        charts: ``n`` charts.
        offsets: ``(n, r, 3)`` from the chart's point, canonical frame, in spacings.
    """
    uv: Tensor = (offsets @ charts.T)[..., :2]
    return uv


def blend(
    surface: Surface,
    charts: Charts,
    offsets: Tensor,
    axes: Tensor,
    spacing: Tensor,
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Land each location on its charts and take the weighted mean.

    Args:
        surface: the f3/f4 head.
        charts: ``m * k`` charts, the ``k`` of each location together.
        offsets: ``(m, k, 3)`` location minus the chart's point, world frame, cloud units.
        axes: ``(m, k, 3, 3)`` canonical frames, rows.
        spacing: ``(m, k)``.

    Returns:
        Step ``(m, 3)`` from the location to the surface, world frame, cloud units; unit normals
        ``(m, 3)``, sign that of the first chart's; logarithm of the expected error in spacings
        ``(m,)``; and of each chart alone its step ``(m, k, 3)`` and log error ``(m, k)``.
    """
    m, k = spacing.shape
    local = (axes @ offsets.unsqueeze(-1)).squeeze(-1) / spacing.unsqueeze(-1)
    uv = parametrise(charts, local.reshape(m * k, 1, 3))
    points, normals, log_error = evaluate(surface, charts, uv)
    step = (points.reshape(m, k, 1, 3) @ axes).squeeze(2) * spacing.unsqueeze(-1) - offsets
    normal = (normals.reshape(m, k, 1, 3) @ axes).squeeze(2)
    log_error = log_error.reshape(m, k)
    distance = local.square().sum(dim=-1)
    weight = functional.softmax(-FALLOFF * distance - TRUST * log_error, dim=-1)
    sign = torch.where((normal * normal[:, :1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    blended = (weight.unsqueeze(-1) * step).sum(dim=1)
    direction = functional.normalize((weight.unsqueeze(-1) * sign * normal).sum(dim=1), dim=-1)
    return blended, direction, (weight * log_error).sum(dim=1), (step, log_error)
