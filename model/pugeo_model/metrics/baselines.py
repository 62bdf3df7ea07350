# SPDX-License-Identifier: Apache-2.0
"""What upsampling reaches without learning: the yardsticks beside our rows.

``plane`` and ``jet`` are our own way of a cloud with a textbook fit in the place of the network:
an even disk of candidates on every point's chart, blending, merge and orientation alike. What the
network adds is the distance to them. ``poisson`` samples a reconstructed surface anew.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.metrics.reconstruction import reconstruct
from pugeo_model.network.pattern import disk
from pugeo_model.options import Options
from pugeo_model.pipeline import Job, Plan, assemble, finish, prepare, survey
from pugeo_model.resample.atlas import BLENDED, Landed
from pugeo_model.resample.selection import nearest_charts, place
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

    def land(
        self,
        spots: NDArray[np.float64],
        owner: NDArray[np.int32],
        neighbours: NDArray[np.int32],
    ) -> Landed:
        """Spots ``(K, 3)`` on the blend of their nearest charts, weighed by distance alone."""
        near = nearest_charts(spots, owner, self.points, neighbours, BLENDED)
        total = np.zeros((len(spots), 1))
        points, normals, first = np.zeros_like(spots), np.zeros_like(spots), np.zeros_like(spots)
        for column, chart in enumerate(near.T):
            offsets = (spots - self.points[chart])[:, :, None]
            local = (self.axes[chart] @ offsets)[:, :, 0] / self.spacing[chart, None]
            lifted, normal = self.lift(chart, local[:, :2])
            first = normal if column == 0 else first
            normal = np.where((normal * first).sum(axis=1, keepdims=True) < 0, -normal, normal)
            weight = np.exp(-_FALLOFF * (local**2).sum(axis=1, keepdims=True)) + 1e-12
            points += weight * lifted
            normals += weight * normal
            total += weight
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return _landed(points / total, normals, near[:, 0])


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
    plan, job = _whole(cloud, 1.0)
    charts = _jets(job)
    rows = np.arange(len(job.points), dtype=np.int32)
    _, normals = charts.lift(rows, np.zeros((len(rows), 2)))
    sparse = assemble(plan, [finish(job, _landed(job.points, normals, rows))]).cloud
    assert sparse.normals is not None
    vertices, faces = reconstruct(sparse.points, sparse.normals)
    wanted = Options(ratio).points_out(len(sparse))
    points = poisson_disk(vertices, faces, wanted, np.random.default_rng(0))
    _, face, _ = MeshDistance(vertices, faces).nearest(points)
    return Cloud(points, normals=face_normals(vertices, faces)[face].astype(np.float32))


def _whole(cloud: Cloud, ratio: float) -> tuple[Plan, Job]:
    """The cloud in one piece, however large."""
    plan = survey(cloud, Options(ratio), tile_size=len(cloud))
    return plan, prepare(plan.tile(0))


def _landed(
    points: NDArray[np.float64], normals: NDArray[np.float64], nearest: NDArray[np.int32]
) -> Landed:
    """Points that expect the same error everywhere: these methods know nothing of theirs."""
    even = np.ones(len(points), dtype=np.float32)
    return Landed(points, normals.astype(np.float32), even, nearest)


def _on_charts(cloud: Cloud, ratio: float, fit: Callable[[Job], _Charts]) -> Cloud:
    """The way of a cloud with charts that nothing was learned for."""
    plan, job = _whole(cloud, ratio)
    charts = fit(job)
    owner = np.repeat(np.arange(len(job.points), dtype=np.int32), job.candidates)
    pattern = np.tile(_DISK * disk(job.candidates).astype(np.float64), (len(job.points), 1))
    proposed, _ = charts.lift(owner, pattern)
    candidates = charts.land(proposed, owner, job.neighbours)
    _, spots, owner = place(
        candidates.points,
        candidates.normals,
        candidates.error,
        candidates.nearest,
        plan.n_out,
        job.share,
        job.neighbours,
        seed=0,
    )
    return assemble(plan, [finish(job, charts.land(spots, owner, job.neighbours))]).cloud


def _planes(job: Job) -> _Charts:
    near = job.points[job.neighbours[:, :_PLANE_NEIGHBOURS]]
    centred = near - near.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("mka,mkb->mab", centred, centred))
    return _Charts(
        job.points,
        vectors[:, :, ::-1].transpose(0, 2, 1),  # eigh sorts upwards, in columns
        job.frames.spacing.astype(np.float64),
        np.zeros_like(job.frames.quadric, dtype=np.float64),
    )


def _jets(job: Job) -> _Charts:
    frames = job.frames
    quadric = frames.quadric.astype(np.float64)
    quadric[:, 0] *= _LIFT
    return _Charts(
        job.points, frames.axes.astype(np.float64), frames.spacing.astype(np.float64), quadric
    )
