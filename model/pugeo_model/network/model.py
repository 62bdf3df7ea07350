# SPDX-License-Identifier: Apache-2.0
"""Interface of the network for the pipeline: numpy arrays, one patch at a time."""

from typing import Any

import numpy as np
import torch

from pugeo_model.geometry.patches import Patch
from pugeo_model.malloc import bound_compiled_products, keep_freed_memory
from pugeo_model.network.heads import combine
from pugeo_model.network.kernels.projection import Projector, bounded_step
from pugeo_model.network.linear import freeze
from pugeo_model.network.neighbourhoods import stack_patches
from pugeo_model.network.pugeo import PUGeoNet
from pugeo_model.resample.atlas import PatchCharts, Projected, ProjectionQuery
from pugeo_model.tuning import TUNING

__all__ = ["Model"]


class Model:
    """A network for inference, with frozen weights.

    Patches are processed one at a time, so that results do not depend on batching or on the
    process that computes them.

    Args:
        net: the network.
        card: its model card.
    """

    def __init__(self, net: PUGeoNet, card: dict[str, Any]) -> None:
        # Before the first matrix product, which the constructor of the projector makes.
        bound_compiled_products()
        keep_freed_memory()
        self.net = net.eval()
        freeze(self.net)
        self.card = card
        self.patch_ratio: None = None
        self._projector = Projector(self.net.surface)

    @torch.inference_mode()
    def charts(self, patch: Patch, count: int) -> PatchCharts:
        """Predict the charts of the core of a patch.

        Args:
            patch: the patch.
            count: candidates per chart.
        """
        core = patch.core
        frames = patch.frames
        quadric = frames.quadric[:core]
        charts, uv = self.net(stack_patches([patch]), torch.from_numpy(quadric), count)
        # On the tangent planes (eq. 4); the pipeline projects them onto the blended charts.
        scaled = torch.from_numpy(frames.axes[:core] * frames.spacing[:core, None, None])
        candidates = combine(uv, charts.T[..., :2].mT @ scaled).numpy()
        return PatchCharts(
            rows=patch.rows[:core],
            candidates=candidates.astype(np.float32, copy=False),
            T=charts.T.numpy(),
            code=charts.code.to(torch.float16).numpy(),
            lift=charts.lift.numpy(),
        )

    def project(self, query: ProjectionQuery) -> Projected:
        """Project each query point onto the blend of its charts."""
        step, normals, log_error = self._projector(query)
        points = bounded_step(query, step, TUNING.largest_offset)
        points[: query.fixed] = query.points[: query.fixed]
        nearest = query.charts[:, 0].copy()
        return Projected(points, normals, np.exp(np.minimum(log_error, 0.0)), nearest)
