# SPDX-License-Identifier: Apache-2.0
"""PUGeo-Net: charts from neighbourhoods, points and normals from charts."""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from pugeo_model.network.backbones import BACKBONES
from pugeo_model.network.heads import Frame, Samples, SurfaceHead
from pugeo_model.network.neighbourhoods import Neighbourhoods
from pugeo_model.network.precision import wide_products

__all__ = ["Architecture", "Charts", "PUGeoNet", "evaluate"]


@dataclass(frozen=True)
class Architecture:
    """Backbone and sizes of a network; stored in the model card.

    Attributes:
        backbone: name in ``BACKBONES``.
        features: channels of the point features ``c_i``.
        options: further arguments of the backbone.
        head: channels of the surface head; the head of the samples has half as many.
        adaptive_uv, linear_map: learn f1 and f2; otherwise the samples of all charts are the same,
            or ``T`` is the canonical frame (ablations of Table 3).
    """

    backbone: str = "charts"
    features: int = 256
    options: tuple[tuple[str, int], ...] = (("width", 160), ("edge_width", 64), ("expansion", 4))
    head: int = 128
    adaptive_uv: bool = True
    linear_map: bool = True

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON-able dictionary; without switches that are on."""
        raw = {**asdict(self), "options": dict(self.options)}
        return {name: value for name, value in raw.items() if value is not True}

    @classmethod
    def from_json(cls, raw: dict[str, Any]) -> "Architecture":
        """Convert from the result of :meth:`to_json`."""
        options = tuple(raw["options"].items())
        switches = {name: raw[name] for name in ("adaptive_uv", "linear_map") if name in raw}
        return cls(raw["backbone"], raw["features"], options, raw.get("head", 128), **switches)


@dataclass(frozen=True, eq=False)
class Charts:
    """The local parametrisations of ``n`` points; lengths in spacings.

    Attributes:
        T: ``(n, 3, 3)`` float32 augmented Jacobian (eq. 5); columns are the two tangents and the
            coarse normal ``T (0, 0, 1)``, in the canonical frame.
        code: ``(n, width)`` input of the surface head.
        lift: ``(n,)`` float32 offset of the chart along its normal.
        quadric: ``(n, 6)`` float32.
    """

    T: Tensor
    code: Tensor
    lift: Tensor
    quadric: Tensor


class PUGeoNet(nn.Module):
    """The network of the paper with an exchangeable backbone.

    Args:
        architecture: backbone and widths.
    """

    def __init__(self, architecture: Architecture | None = None) -> None:
        super().__init__()
        self.architecture = architecture or Architecture()
        features = self.architecture.features
        self.backbone = BACKBONES[self.architecture.backbone](
            features=features, **dict(self.architecture.options)
        )
        self.frame = Frame(features, learned=self.architecture.linear_map)
        head = self.architecture.head
        self.samples = Samples(features, head // 2, learned=self.architecture.adaptive_uv)
        self.surface = SurfaceHead(features, head, head // 2)

    def forward(self, hoods: Neighbourhoods, quadric: Tensor, count: int) -> tuple[Charts, Tensor]:
        """Predict the charts of the core points and their adaptive samples.

        Args:
            hoods: the neighbourhoods.
            quadric: ``(n, 6)`` float32 of the core points.
            count: samples per chart.

        Returns:
            The charts and (u, v) ``(n, count, 2)`` float32.
        """
        with wide_products():
            features = self.backbone(hoods)
        # Rows of the padding are computed and discarded, see `stack_patches`.
        core = len(quadric)
        padded = functional.pad(quadric, (0, 0, 0, len(features) - core))
        code, lift = self.surface.encode(features, padded)
        frame, uv = self.frame(features), self.samples(features, count)
        return Charts(frame[:core], code[:core], lift[:core], quadric), uv[:core]


def evaluate(surface: SurfaceHead, charts: Charts, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Evaluate points and normals of charts at (u, v) (eq. 4, 6 and 8).

    ``x = T (u, v, 0) + delta T (0, 0, 1)`` and ``n = T (offset + (0, 0, 1))``, normalised.

    Args:
        surface: the f3/f4 head.
        charts: ``n`` charts.
        uv: ``(n, r, 2)`` float32, in spacings.

    Returns:
        Points ``(n, r, 3)`` and unit normals ``(n, r, 3)`` in the canonical frames, in spacings,
        and the log of the predicted error ``(n, r)``.
    """
    displacement, normal, log_error = surface(charts.code, charts.lift, charts.quadric, uv)
    local = torch.cat([uv, displacement.unsqueeze(-1)], dim=-1)
    turn = charts.T.mT
    return local @ turn, normal @ turn, log_error
