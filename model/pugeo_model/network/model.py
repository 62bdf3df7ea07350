# SPDX-License-Identifier: Apache-2.0
"""The network as the pipeline calls it: numpy in, numpy out, one patch at a time."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray


from pugeo_model.geometry.patches import Patch
from pugeo_model.network.blend import blend
from pugeo_model.network.neighbourhoods import gather
from pugeo_model.network.pugeo import Charts, PUGeoNet, evaluate

__all__ = ["Landed", "Landing", "Model", "PatchCharts"]


@dataclass(frozen=True, eq=False)
class PatchCharts:
    """Charts of a patch's core and what they propose.

    Attributes:
        rows: ``(n,)`` int32 rows in the cloud.
        candidates: ``(n, c, 3)`` float32 offsets from the points, cloud frame, unit scale.
        normals: ``(n, c, 3)`` float32 unit.
        log_error: ``(n, c)`` float32, in spacings.
        T: ``(n, 3, 3)`` float32, in canonical frames.
        code: ``(n, width)`` float16.
        lift: ``(n,)`` float32.
    """

    rows: NDArray[np.int32]
    candidates: NDArray[np.float32]
    normals: NDArray[np.float32]
    log_error: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Landing:
    """Spots to be landed, with the charts they need.

    Attributes:
        spots: ``(m, 3)`` float64, unit scale.
        charts: ``(m, k)`` int32 rows of the arrays below, nearest first.
        points: ``(n, 3)`` float64; the rest as in :class:`PatchCharts` and ``Frames``.
        nearest: ``(m,)`` int32 row in the cloud of the nearest input point.
        fixed: the spots stay where they are and only get normals.
    """

    spots: NDArray[np.float64]
    charts: NDArray[np.int32]
    points: NDArray[np.float64]
    axes: NDArray[np.float32]
    spacing: NDArray[np.float32]
    quadric: NDArray[np.float32]
    T: NDArray[np.float32]
    code: NDArray[np.float16]
    lift: NDArray[np.float32]
    nearest: NDArray[np.int32]
    fixed: bool


@dataclass(frozen=True, eq=False)
class Landed:
    """Points on the surface.

    Attributes:
        points: ``(m, 3)`` float64, unit scale.
        normals: ``(m, 3)`` float32 unit, sign that of the nearest chart's frame.
        nearest: ``(m,)`` int32 row in the cloud of the nearest input point.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    nearest: NDArray[np.int32]


class Model:
    """A network ready to serve.

    Patches are taken one at a time, always whole, so results cannot depend on how many are
    batched or who computes them.

    Args:
        net: the network.
        card: its model card.
    """

    def __init__(self, net: PUGeoNet, card: dict[str, Any]) -> None:
        self.net = net.eval()
        self.card = card

    @torch.inference_mode()
    def charts(self, patch: Patch, count: int) -> PatchCharts:
        """Charts of the core points and ``count`` candidates from each."""
        core = patch.core
        frames = patch.frames
        axes = torch.from_numpy(frames.axes[:core])
        spacing = torch.from_numpy(frames.spacing[:core])
        quadric = torch.from_numpy(frames.quadric[:core])
        charts, uv = self.net(gather([patch]), quadric, count)
        local, normals, log_error = evaluate(self.net.surface, charts, uv)
        return PatchCharts(
            rows=patch.rows[:core],
            candidates=((local @ axes) * spacing[:, None, None]).numpy(),
            normals=(normals @ axes).numpy(),
            log_error=log_error.numpy(),
            T=charts.T.numpy(),
            code=charts.code.to(torch.float16).numpy(),
            lift=charts.lift.numpy(),
        )

    @torch.inference_mode()
    def land(self, landing: Landing) -> Landed:
        """Put every spot on the blend of its charts."""
        rows = torch.from_numpy(landing.charts.astype(np.int64))
        flat = rows.flatten()
        offsets = landing.spots[:, None] - landing.points[landing.charts]
        charts = Charts(
            torch.from_numpy(landing.T)[flat],
            torch.from_numpy(landing.code).to(torch.bfloat16)[flat],
            torch.from_numpy(landing.lift)[flat],
            torch.from_numpy(landing.quadric)[flat],
        )
        step, normals, _, _ = blend(
            self.net.surface,
            charts,
            torch.from_numpy(offsets.astype(np.float32)),
            torch.from_numpy(landing.axes)[rows],
            torch.from_numpy(landing.spacing)[rows],
        )
        spots = landing.spots
        return Landed(
            spots if landing.fixed else spots + step.numpy(), normals.numpy(), landing.nearest
        )
