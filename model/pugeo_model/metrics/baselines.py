# SPDX-License-Identifier: Apache-2.0
"""What upsampling reaches without learning: the yardsticks beside our rows.

``plane`` and ``jet`` are our own way of a cloud with a textbook fit in the select of the network:
an even disk of candidates on every point's chart, blending, merge and orientation alike. What the
network adds is the distance to them. ``poisson`` samples a reconstructed surface anew.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.assembly import assemble
from pugeo_model.cloud import Cloud
from pugeo_model.finish import UpsampledTile, finish
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.metrics.reconstruction import reconstruct
from pugeo_model.network.pattern import disk
from pugeo_model.options import Options
from pugeo_model.pipeline import run_here, upsample_tile
from pugeo_model.plan import Plan, make_plan
from pugeo_model.prepare import PreparedTile, prepare
from pugeo_model.resample.atlas import BLENDED_CHARTS, Projected
from pugeo_model.resample.selection import nearest_charts, select
from pugeo_model.tiles import Tile
from pugeo_model.training.corpus import face_normals, poisson_disk

__all__ = ["jet", "plane", "poisson"]

_FALLOFF = 2.0  # of a chart's weight with the squared distance in spacings, as in the network
_PLANE_NEIGHBOURS = 16  # as one takes for PCA normals
_LIFT = 0.5  # share of the quadric's constant, as in the network before its first step
_DISK = 0.87  # side, in spacings, of the square as large as one point's share of the surface


@dataclass(frozen=True, eq=False)
class _Charts:
    """A height field over the tangent plane of every point.

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
        """Points ``(K, 3)`` and unit normals ``(K, 3)`` at ``uv`` ``(K, 2)`` of their charts."""
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
        """Query points ``(K, 3)`` on the blend of their nearest charts, weighed by distance alone."""
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
            weight = np.exp(-_FALLOFF * (local**2).sum(axis=1, keepdims=True)) + 1e-12
            points += weight * lifted
            normals += weight * normal
            total += weight
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return _projected(points / total, normals, near[:, 0])


def plane(cloud: Cloud, ratio: float) -> Cloud:
    """PCA of 16 neighbours: every point's tangent plane, its samples on that plane."""
    return _on_charts(cloud, ratio, _planes)


def jet(cloud: Cloud, ratio: float) -> Cloud:
    """A quadric fitted to the neighbours in the canonical frame: where training starts from."""
    return _on_charts(cloud, ratio, _jets)


def poisson(cloud: Cloud, ratio: float) -> Cloud:
    """Screened Poisson reconstruction of the input with the jet's normals, sampled evenly anew.

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
    points = poisson_disk(vertices, faces, wanted, np.random.default_rng(0))
    _, face, _ = MeshDistance(vertices, faces).nearest(points)
    return Cloud(points, normals=face_normals(vertices, faces)[face].astype(np.float32))


def _whole(cloud: Cloud, ratio: float) -> Plan:
    """The cloud in one piece, however large."""
    return make_plan(cloud, Options(ratio), tile_size=len(cloud))


def _projected(
    points: NDArray[np.float64], normals: NDArray[np.float64], nearest: NDArray[np.int32]
) -> Projected:
    """Points that expect the same error everywhere: these methods know nothing of theirs."""
    even = np.ones(len(points), dtype=np.float32)
    return Projected(points, normals.astype(np.float32), even, nearest)


@dataclass(frozen=True)
class _FittedStages:
    """The stages of a tile with charts that are fitted and not predicted.

    Attributes:
        fit: charts of a prepared tile.
    """

    fit: Callable[[PreparedTile], _Charts]

    async def prepare(self, tile: Tile) -> PreparedTile:
        return prepare(tile)

    async def predict(self, prepared: PreparedTile) -> _Charts:
        return self.fit(prepared)

    def needs_denoising(self, prepared: PreparedTile) -> bool:
        """Never: noise is smoothed by fitting alone."""
        return False

    async def denoise(self, prepared: PreparedTile, charts: _Charts) -> Tile | None:
        return None

    async def densify(self, prepared: PreparedTile, charts: _Charts) -> UpsampledTile:
        tile, neighbours = prepared.tile, prepared.neighbours
        count = len(prepared.points)
        owner = np.repeat(np.arange(count, dtype=np.int32), tile.candidates)
        pattern = np.tile(_DISK * disk(tile.candidates).astype(np.float64), (count, 1))
        proposed, _ = charts.lift(owner, pattern)
        candidates = charts.project(proposed, owner, neighbours)
        _, points, owner = select(
            candidates.points,
            candidates.normals,
            candidates.error,
            candidates.nearest,
            tile.n_out,
            prepared.area,
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
    near = prepared.points[prepared.neighbours[:, :_PLANE_NEIGHBOURS]]
    centred = near - near.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("mka,mkb->mab", centred, centred))
    return _Charts(
        prepared.points,
        vectors[:, :, ::-1].transpose(0, 2, 1),  # eigh sorts upwards, in columns
        prepared.frames.spacing.astype(np.float64),
        np.zeros_like(prepared.frames.quadric, dtype=np.float64),
    )


def _jets(prepared: PreparedTile) -> _Charts:
    frames = prepared.frames
    quadric = frames.quadric.astype(np.float64)
    quadric[:, 0] *= _LIFT
    return _Charts(
        prepared.points, frames.axes.astype(np.float64), frames.spacing.astype(np.float64), quadric
    )
