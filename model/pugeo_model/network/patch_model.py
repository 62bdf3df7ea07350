# SPDX-License-Identifier: Apache-2.0
"""A patch network as the pipeline calls it: numpy in, numpy out, one patch at a time."""

from typing import Any

import numpy as np
import torch

from pugeo_model.geometry.overlapping import PointPatch
from pugeo_model.malloc import bound_compiled_products, keep_freed_memory
from pugeo_model.resample.overlap import PatchPoints

__all__ = ["PatchModel"]


class PatchModel:
    """A network of ``PATCH_NETWORKS`` ready to serve.

    Patches are taken one at a time, so results cannot depend on how many are batched.

    Args:
        net: the network.
        card: its model card.
    """

    def __init__(self, net: Any, card: dict[str, Any]) -> None:
        bound_compiled_products()
        keep_freed_memory()
        self.net = net.eval()
        self.card = card
        self.patch_ratio: int = net.ratio

    @torch.inference_mode()
    def charts(self, patch: PointPatch, count: int) -> PatchPoints:  # noqa: ARG002
        """Samples of every point of the patch, in the cloud's frame.

        The network's own ratio decides how many; ``count`` has no say.
        """
        output = self.net(torch.from_numpy(patch.points).unsqueeze(0))
        points = output.points[0].numpy().astype(np.float64)
        return PatchPoints(
            patch.rows,
            patch.centre + patch.radius * points,
            None if output.normals is None else output.normals[0].numpy(),
            None if output.coarse_normals is None else output.coarse_normals[0].numpy(),
            np.linalg.norm(patch.points, axis=1),
        )
