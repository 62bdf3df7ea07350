# SPDX-License-Identifier: Apache-2.0
"""Baselines without learning, for comparison with the network.

``plane`` and ``jet`` run the same pipeline with fitted charts in place of predicted ones: an even
disk of candidates on each chart, then blending, selection and orientation. The difference to the
model is the contribution of the network. ``poisson`` samples a reconstructed surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.assembly import assemble
from pugeo_model.cloud import Cloud
from pugeo_model.finish import UpsampledTile, finish
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.mesh.sampling import face_normals, poisson_disk
from pugeo_model.metrics.reconstruction import reconstruct
from pugeo_model.network.pattern import DISK_SIDE, disk
from pugeo_model.options import Options
from pugeo_model.pipeline import run_here, upsample_tile
from pugeo_model.plan import Plan, make_plan
from pugeo_model.prepare import PreparedTile, prepare
from pugeo_model.resample.atlas import BLENDED_CHARTS, Projected
from pugeo_model.resample.nearest_charts import nearest_charts
from pugeo_model.resample.selection import select
from pugeo_model.tiles import Tile
from pugeo_model.tuning import TUNING

__all__ = ["jet", "plane", "poisson"]

_PLANE_NEIGHBOURS = 16  # a usual number for PCA normals
_LIFT = 0.5  # fraction of the quadric's constant, as in the untrained network


@dataclass(frozen=True, eq=False)
class _Charts:
    """A height field over the tangent plane of each point.

    Attributes:
        points: ``(M, 3)``.
        axes: ``(M, 3, 3)``, rows ``t1, t2, n``.
        spacing: ``(M,)``.
        quadric: ``(M, 6)``, lengths in spacings.
    """

    points: NDArray[np.float64]
    axes: NDArray[np.float64]
    spacing: NDArray[np.float64]
    quadric: NDArray[np.float64]

    def lift(
        self, owner: NDArray[np.integer], uv: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Evaluate points ``(K, 3)`` and unit normals ``(K, 3)`` of charts at ``uv`` ``(K, 2)``."""
        u, v = uv.T
        c0, c1, c2, c3, c4, c5 = self.quadric[owner].T
        height = c0 + c1 * u + c2 * v + 0.5 * c3 * u * u + c4 * u * v + 0.5 * c5 * v * v
        slopes = -np.stack([c1 + c3 * u + c4 * v, c2 + c4 * u + c5 * v], axis=1)
        normals = np.concatenate([slopes, np.ones_like(slopes[:, :1])], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        local = np.concatenate([uv, height[:, None]], axis=1)[:, None]
        axes = self.axes[owner]
        offsets = (local @ axes)[:, 0] * self.spacing[owner, None]
        return self.points[owner] + offsets, (normals[:, None] @ axes)[:, 0]

    def project(
        self,
        queries: NDArray[np.float64],
        owner: NDArray[np.int32],
        neighbours: NDArray[np.int32],
    ) -> Projected:
        """Project points ``(K, 3)`` onto their nearest charts, blended by distance only."""
        near = nearest_charts(queries, owner, self.points, neighbours, BLENDED_CHARTS)
        total = np.zeros((len(queries), 1))
        points, normals, first = (
            np.zeros_like(queries),
            np.zeros_like(queries),
            np.zeros_like(queries),
        )
        for column, chart in enumerate(near.T):
            offsets = (queries - self.points[chart])[:, :, None]
            local = (self.axes[chart] @ offsets)[:, :, 0] / self.spacing[chart, None]
            lifted, normal = self.lift(chart, local[:, :2])
            first = normal if column == 0 else first
            normal = np.where((normal * first).sum(axis=1, keepdims=True) < 0, -normal, normal)
            weight = np.exp(-TUNING.blend_falloff * (local**2).sum(axis=1, keepdims=True)) + 1e-12
            points += weight * lifted
            normals += weight * normal
            total += weight
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return _projected(points / total, normals, near[:, 0])


def plane(cloud: Cloud, ratio: float) -> Cloud:
    """Upsample on the tangent planes of the points, from PCA of 16 neighbours."""
    return _on_charts(cloud, ratio, _planes)


def jet(cloud: Cloud, ratio: float) -> Cloud:
    """Upsample on quadrics fitted in canonical frames (jets), the starting point of training."""
    return _on_charts(cloud, ratio, _jets)


def poisson(cloud: Cloud, ratio: float) -> Cloud:
    """Upsample by screened Poisson reconstruction with normals of jets, sampled evenly.

    Raises:
        ModuleNotFoundError: pycolmap is not installed.
    """
    plan = _whole(cloud, 1.0)
    prepared = prepare(plan.tile(0))
    rows = np.arange(len(prepared.points), dtype=np.int32)
    _, normals = _jets(prepared).lift(rows, np.zeros((len(rows), 2)))
    oriented = finish(prepared, _projected(prepared.points, normals, rows))
    sparse = assemble(plan, [oriented]).cloud
    assert sparse.normals is not None
    vertices, faces = reconstruct(sparse.points, sparse.normals)
    wanted = Options(ratio).points_out(len(sparse))
    assert wanted is not None
    points = poisson_disk(vertices, faces, wanted, np.random.default_rng(0))
    _, face, _ = MeshDistance(vertices, faces).nearest(points)
    return Cloud(points, normals=face_normals(vertices, faces)[face].astype(np.float32))


def _whole(cloud: Cloud, ratio: float) -> Plan:
    """Plan with a single tile, for a cloud of any size."""
    return make_plan(cloud, Options(ratio), tile_size=len(cloud))


def _projected(
    points: NDArray[np.float64], normals: NDArray[np.float64], nearest: NDArray[np.int32]
) -> Projected:
    """Projected points with the same error everywhere, since these methods predict none."""
    even = np.ones(len(points), dtype=np.float32)
    return Projected(points, normals.astype(np.float32), even, nearest)


@dataclass(frozen=True)
class _FittedStages:
    """The stages of a tile with fitted charts in place of predicted ones.

    Attributes:
        fit: fits the charts of a prepared tile.
    """

    fit: Callable[[PreparedTile], _Charts]

    async def prepare(self, tile: Tile) -> PreparedTile:
        return prepare(tile)

    async def predict(self, prepared: PreparedTile) -> _Charts:
        return self.fit(prepared)

    def needs_denoising(self, _prepared: PreparedTile) -> bool:
        """Return ``False``: the fit alone removes noise."""
        return False

    async def denoise(self, _prepared: PreparedTile, _charts: _Charts) -> Tile | None:
        return None

    async def densify(self, prepared: PreparedTile, charts: _Charts) -> UpsampledTile:
        tile, neighbours = prepared.tile, prepared.neighbours
        count = len(prepared.points)
        owner = np.repeat(np.arange(count, dtype=np.int32), prepared.candidates)
        pattern = np.tile(DISK_SIDE * disk(prepared.candidates).astype(np.float64), (count, 1))
        proposed, _ = charts.lift(owner, pattern)
        candidates = charts.project(proposed, owner, neighbours)
        _, points, owner = select(
            candidates.points,
            candidates.normals,
            candidates.error,
            candidates.nearest,
            tile.n_out,
            prepared.radii,
            neighbours,
            seed=0,
        )
        return finish(prepared, charts.project(points, owner, neighbours))


def _on_charts(cloud: Cloud, ratio: float, fit: Callable[[PreparedTile], _Charts]) -> Cloud:
    """Upsample a cloud on fitted charts."""
    plan = _whole(cloud, ratio)
    tile = run_here(upsample_tile(_FittedStages(fit), plan.tile(0)))
    return assemble(plan, [tile]).cloud


def _planes(prepared: PreparedTile) -> _Charts:
    """Fit tangent planes by PCA."""
    near = prepared.points[prepared.neighbours[:, :_PLANE_NEIGHBOURS]]
    centred = near - near.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("mka,mkb->mab", centred, centred))
    return _Charts(
        prepared.points,
        vectors[:, :, ::-1].transpose(0, 2, 1),  # eigh returns columns, ascending
        prepared.frames.spacing.astype(np.float64),
        np.zeros_like(prepared.frames.quadric, dtype=np.float64),
    )


def _jets(prepared: PreparedTile) -> _Charts:
    """Use the quadrics of the canonical frames."""
    frames = prepared.frames
    quadric = frames.quadric.astype(np.float64)
    quadric[:, 0] *= _LIFT
    return _Charts(
        prepared.points, frames.axes.astype(np.float64), frames.spacing.astype(np.float64), quadric
    )
