# SPDX-License-Identifier: Apache-2.0
"""The network as the pipeline calls it: numpy in, numpy out, one patch at a time."""

from typing import Any

import numpy as np
import torch

from pugeo_model.geometry.patches import Patch
from pugeo_model.merge.atlas import Landed, Landing, PatchCharts
from pugeo_model.network.heads import spread
from pugeo_model.network.landing import Lander, settle
from pugeo_model.network.linear import serve
from pugeo_model.network.memory import bound_compiled_products, keep_freed_memory
from pugeo_model.network.neighbourhoods import gather
from pugeo_model.network.pugeo import PUGeoNet

__all__ = ["Model"]

# Spacings from its nearest input point that a point may lie at most. The widest holes of an even
# scan are 0.85 deep; what a chart says beyond is invention: on a LiDAR's far field points flew off.
_FURTHEST = 1.25


class Model:
    """A network ready to serve.

    Patches are taken one at a time, always whole, so results cannot depend on how many are
    batched or who computes them.

    Args:
        net: the network.
        card: its model card.
    """

    def __init__(self, net: PUGeoNet, card: dict[str, Any]) -> None:
        # First of all, since a lander tries a product out.
        bound_compiled_products()
        keep_freed_memory()
        self.net = net.eval()
        serve(self.net)
        self.card = card
        self.patch_ratio: int | None = None
        self._lander = Lander(self.net.surface)

    @torch.inference_mode()
    def charts(self, patch: Patch, count: int) -> PatchCharts:
        """Charts of the core points and ``count`` candidates from each."""
        core = patch.core
        frames = patch.frames
        quadric = frames.quadric[:core]
        charts, uv = self.net(gather([patch]), torch.from_numpy(quadric), count)
        # On the tangent planes: the pipeline lands them, on their neighbours' charts as well.
        scaled = torch.from_numpy(frames.axes[:core] * frames.spacing[:core, None, None])
        candidates = spread(uv, charts.T[..., :2].mT @ scaled).numpy()
        return PatchCharts(
            rows=patch.rows[:core],
            candidates=candidates.astype(np.float32, copy=False),
            T=charts.T.numpy(),
            code=charts.code.to(torch.float16).numpy(),
            lift=charts.lift.numpy(),
        )

    def land(self, landing: Landing) -> Landed:
        """Put every spot on the blend of its charts."""
        step, normals, log_error = self._lander(landing)
        points = settle(landing, step, _FURTHEST)
        points[: landing.fixed] = landing.spots[: landing.fixed]
        nearest = landing.charts[:, 0].copy()
        return Landed(points, normals, np.exp(np.minimum(log_error, 0.0)), nearest)
