# SPDX-License-Identifier: Apache-2.0
"""Projection of points onto the nearest charts, and blending of the charts.

The weight of a chart falls with its distance and with its predicted error: near a crease or a
thin wall, the charts of the other side predict large errors and get small weights.
"""

import torch
from torch import Tensor
from torch.nn import functional

from pugeo_model.network.heads import SurfaceHead
from pugeo_model.network.pugeo import Charts, evaluate
from pugeo_model.tuning import TUNING

__all__ = ["FALLOFF", "TRUST", "blend", "parametrise"]

FALLOFF = TUNING.blend_falloff
"""Decrease of the log weight of a chart per squared distance in spacings."""

TRUST = TUNING.blend_trust
"""Power of the inverse predicted error in the weight of a chart."""


def parametrise(charts: Charts, offsets: Tensor) -> Tensor:
    """Compute the parameters (u, v) of points in their charts: ``T^-1 x``, with T orthonormal.

    Args:
        charts: ``n`` charts.
        offsets: ``(n, r, 3)`` from the point of the chart, canonical frame, in spacings.

    Returns:
        ``(n, r, 2)`` in spacings.
    """
    uv: Tensor = (offsets @ charts.T)[..., :2]
    return uv


def blend(
    surface: SurfaceHead,
    charts: Charts,
    offsets: Tensor,
    axes: Tensor,
    spacing: Tensor,
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Project each point onto its charts and average with weights.

    Chart c at distance ``d_c`` (in spacings) with predicted error ``e_c`` has the weight
    ``w_c = exp(-FALLOFF d_c^2) e_c^-TRUST / sum``; step and normal are ``sum_c w_c step_c`` and
    ``sum_c w_c (+-n_c)``, normalised, with the signs of the first chart.

    Args:
        surface: the f3/f4 head.
        charts: ``m * k`` charts, the ``k`` of each point together.
        offsets: ``(m, k, 3)`` point minus the point of the chart, frame and units of the cloud.
        axes: ``(m, k, 3, 3)`` canonical frames, rows.
        spacing: ``(m, k)``.

    Returns:
        Step ``(m, 3)`` from the point to the surface, frame and units of the cloud; unit normals
        ``(m, 3)``; log of the predicted error in spacings ``(m,)``; and for each single chart its
        step ``(m, k, 3)`` and log error ``(m, k)``.
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
