# SPDX-License-Identifier: Apache-2.0
"""The joint loss: coverage, point to surface, coarse and refined normals, blended charts.

The paper weighs Chamfer distance and the two normal losses 100, 1, 1 (eq. 12). Chamfer against a
sample of equal size has a floor set by chance; its two halves are replaced by terms that have
none: *coverage*, the mean squared distance from the true surface to the nearest prediction (the
energy of a centroidal tessellation), and *P2F*, the exact distance from a prediction to the mesh.
All lengths are in units of the local spacing.

The paper prints the unoriented normal loss as the *max* over both signs of the true normal
(eq. 10, 11); only the *min* is an unoriented difference. Its plain length, not its square, is
taken: near a crease some normals must be wrong by much, and squares would let them rule.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pugeo_model.merge.atlas import BLENDED
from pugeo_model.metrics.surface_distance import MeshDistance
from pugeo_model.network.blend import blend
from pugeo_model.network.neighbourhoods import gather
from pugeo_model.network.pugeo import Charts, PUGeoNet, evaluate
from pugeo_model.training.batches import Sample
from pugeo_model.training.corpus import Shape

__all__ = ["JointLoss", "Weights"]

_SPOTS = 3  # of each chart, at which it is blended with others


@dataclass(frozen=True)
class Weights:
    """Weights of the terms, and how noise lowers the weight of a patch.

    Attributes:
        coverage: of ``z + z^2 / (1 + z)`` with ``z = R d^2 / s^2`` over true surface samples: holes
            count double, but those of random inputs, which no chart can reach, do not rule.
        p2f: of the distance; ``3 R`` times its square, linear beyond 0.1 spacings, is always
            added, for outliers.
        coarse_normal: of ``T (0, 0, 1)``.
        refined_normal: of the final normal.
        blended: of P2F and normals of blended charts; of the latter the less, the less
            ``refined_normal`` is below 1/6, so that without it nothing supervises normals.
        confidence: of the regression of each chart's log error.
        noise: a patch's weight is ``1 / (1 + noise * sigma / s)``: its loss is large whatever
            the network does, and must not drown the clean ones.
    """

    coverage: float = 1.0
    p2f: float = 3.0
    coarse_normal: float = 0.2
    refined_normal: float = 0.5
    blended: float = 3.0
    confidence: float = 0.05
    noise: float = 2.0


@dataclass(frozen=True, eq=False)
class _Ground:
    """What the charts of all patches stand on, one patch after the other.

    Attributes:
        core: charts of each patch.
        start: ``(patches,)`` first row of each.
        points, axes, spacing, quadric: of the ``n`` charts, as in ``Patch`` and ``Frames``.
        trust: ``(n,)`` weight by the noise of the patch.
        truths: ``(G, 3)`` of all patches.
        owners: ``(G, 6)`` rows of charts that may cover each.
    """

    core: list[int]
    start: np.ndarray
    points: Tensor
    axes: Tensor
    spacing: Tensor
    quadric: Tensor
    trust: Tensor
    truths: Tensor
    owners: Tensor

    @classmethod
    def of(cls, samples: Sequence[Sample], noise: float) -> "_Ground":
        core = [sample.patch.core for sample in samples]
        start = np.cumsum([0, *core[:-1]])
        frames = [sample.patch.frames for sample in samples]
        each = list(zip(samples, core, strict=True))
        owners = [s.owners + b for s, b in zip(samples, start, strict=True)]
        return cls(
            core,
            start,
            points=_rows([s.patch.points[:n] for s, n in each]),
            axes=_rows([f.axes[:n] for f, n in zip(frames, core, strict=True)]),
            spacing=_rows([f.spacing[:n] for f, n in zip(frames, core, strict=True)]),
            quadric=_rows([f.quadric[:n] for f, n in zip(frames, core, strict=True)]),
            trust=_rows([np.full(n, 1 / (1 + noise * s.noise)) for s, n in each]),
            truths=_rows([sample.truths for sample in samples]),
            owners=torch.from_numpy(np.concatenate(owners)),
        )


class JointLoss:
    """Loss of a batch.

    Args:
        shapes: the corpus that ``Sample.shape`` indexes.
        weights: weights of the terms.
    """

    def __init__(self, shapes: Sequence[Shape], weights: Weights | None = None) -> None:
        self.shapes = shapes
        self.weights = weights or Weights()
        self._distances: dict[int, MeshDistance] = {}

    def __call__(
        self, net: PUGeoNet, count: int, samples: Sequence[Sample], rng: np.random.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        """Scalar loss and its parts, each a mean over the batch.

        Args:
            net: the network.
            count: samples a chart.
            samples: the patches.
            rng: draws the locations at which charts are blended.
        """
        w = self.weights
        ground = _Ground.of(samples, w.noise)
        points, axes, spacing, trust = ground.points, ground.axes, ground.spacing, ground.trust

        charts, uv = net(gather([sample.patch for sample in samples]), ground.quadric, count)
        local, normals, log_error = evaluate(net.surface, charts, uv)
        cloud = points[:, None] + spacing[:, None, None] * (local @ axes)
        world_normals = normals @ axes
        coarse = (charts.T[..., 2].unsqueeze(1) @ axes).squeeze(1)

        foot, true_normal = self._project(samples, ground.core, cloud.detach())
        miss = _length(cloud - foot) / spacing[:, None]
        turn = _unoriented(world_normals, true_normal)
        coarse_turn = _unoriented(coarse.unsqueeze(1), true_normal)
        share = trust[:, None] / trust.sum() / count

        # Truths of all patches against the charts that may cover them.
        truths, owners = ground.truths, ground.owners
        with torch.no_grad():
            apart = (cloud[owners] - truths[:, None, None]).square().sum(-1).flatten(1)
            best = apart.argmin(dim=1)
            winner = owners.gather(1, (best // count).unsqueeze(1)).squeeze(1)
        reached = cloud[winner, best % count]
        z = count * (reached - truths).square().sum(-1) / spacing[winner].square()
        held = trust[winner] / trust[winner].sum()

        expected = (log_error - torch.log(miss.detach() + 0.005)).abs()
        parts = {
            "coverage": (held * (z + z.square() / (1.0 + z))).sum(),
            "p2f": (share * miss).sum(),
            "outliers": (share * _outlying(miss)).sum(),
            "coarse_normal": (share * coarse_turn).sum(),
            "refined_normal": (share * turn).sum(),
            "confidence": (share * expected).sum(),
        }
        parts |= self._blended(net, charts, samples, ground, cloud, rng)
        total = (
            w.coverage * parts["coverage"]
            + w.p2f * parts["p2f"]
            + 3.0 * count * parts["outliers"]
            + w.coarse_normal * parts["coarse_normal"]
            + w.refined_normal * parts["refined_normal"]
            + w.blended
            * (
                parts["blended_p2f"]
                + min(6 * w.refined_normal, 1.0) * parts["blended_normal"] / 6
                + parts["chart_p2f"] / 2
            )
            + w.confidence * (parts["confidence"] + parts["chart_confidence"])
        )
        return total, {name: float(part.detach()) for name, part in parts.items()}

    def _blended(
        self,
        net: PUGeoNet,
        charts: Charts,
        samples: Sequence[Sample],
        ground: "_Ground",
        cloud: Tensor,
        rng: np.random.Generator,
    ) -> dict[str, Tensor]:
        """Charts judged where others put their samples: there they are blended when served.

        And where the surface is: what lies on it has to stay, also on a ridge, from which the
        mean of the charts of both sides would pull it back.
        """
        points, axes, spacing, trust = ground.points, ground.axes, ground.spacing, ground.trust
        start, truths, owners = ground.start, ground.truths, ground.owners
        near = np.concatenate([s.near + b for s, b in zip(samples, start, strict=True)])
        ends = np.repeat(start + np.array(ground.core), ground.core)
        whole = torch.from_numpy(np.flatnonzero((near[:, :8] < ends[:, None]).all(axis=1)))
        pick = torch.from_numpy(rng.integers(cloud.shape[1], size=(len(whole), _SPOTS)))
        jitter = torch.from_numpy(
            rng.normal(size=(len(whole), _SPOTS, 3), scale=0.1).astype(np.float32)
        )
        spots = cloud.detach()[whole[:, None], pick] + jitter * spacing[whole, None, None]
        candidates = torch.cat([whole[:, None], torch.from_numpy(near)[whole, :8]], dim=1)
        apart = (spots[:, :, None] - points[candidates][:, None]).square().sum(-1)
        ranks = apart.topk(BLENDED, dim=-1, largest=False).indices
        chosen = candidates.unsqueeze(1).expand(-1, _SPOTS, -1).gather(2, ranks)
        held = torch.from_numpy(rng.permutation(len(truths))[: len(whole)])
        spots = torch.cat([spots.reshape(-1, 3), truths[held]])
        chosen = torch.cat([chosen.reshape(-1, BLENDED), owners[held, :BLENDED]])
        owner = torch.cat([whole.repeat_interleave(_SPOTS), owners[held, 0]])
        # Patch by patch, as their meshes are asked.
        patch = torch.from_numpy(np.searchsorted(start, owner.numpy(), side="right") - 1)
        order = torch.argsort(patch, stable=True)
        spots, chosen, owner = spots[order], chosen[order], owner[order]
        stays = (order >= len(order) - len(held)).unsqueeze(1)
        flat = chosen.flatten()
        picked = Charts(charts.T[flat], charts.code[flat], charts.lift[flat], charts.quadric[flat])
        offsets = spots[:, None] - points[chosen]
        step, normal, _, (steps, log_errors) = blend(
            net.surface, picked, offsets, axes[chosen], spacing[chosen]
        )
        landed = spots + step
        counts = torch.bincount(patch, minlength=len(samples)).tolist()
        foot, true_normal = self._project(samples, counts, landed.detach())
        scale = spacing[owner]
        share = trust[owner] / trust[owner].sum()
        miss = _length(landed - torch.where(stays, spots, foot)) / scale
        turn = _unoriented(normal, true_normal)
        # One chart alone is judged against the foot's plane: near enough, and a search less.
        alone = spots[:, None] + steps - foot[:, None]
        alone = (alone * true_normal[:, None]).sum(-1).abs() / scale[:, None]
        distance = offsets.square().sum(-1) / spacing[chosen].square()
        nearby = torch.exp(-distance / 0.64) / BLENDED
        expected = (log_errors - torch.log(alone.detach() + 0.005)).abs().mean(dim=1)
        return {
            "blended_p2f": (share * (miss + cloud.shape[1] * _outlying(miss))).sum(),
            "blended_normal": (share * turn).sum(),
            "chart_p2f": (share * (nearby * alone).sum(dim=1)).sum(),
            "chart_confidence": (share * expected).sum(),
        }

    def _project(
        self, samples: Sequence[Sample], counts: list[int], cloud: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Feet and face normals on each sample's own mesh, in the shape of ``cloud``."""
        feet, normals = [], []
        for sample, part in zip(samples, cloud.split(counts), strict=True):
            shape = self.shapes[sample.shape]
            if sample.shape not in self._distances:
                self._distances[sample.shape] = MeshDistance(shape.vertices, shape.faces)
            _, face, foot = self._distances[sample.shape].nearest(
                part.reshape(-1, 3).numpy().astype(np.float64)
            )
            feet.append(foot.reshape(part.shape))
            normals.append(shape.normals[face].reshape(part.shape))
        return _rows(feet), _rows(normals)


def _rows(arrays: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.concatenate(arrays).astype(np.float32, copy=False))


def _length(vectors: Tensor) -> Tensor:
    """Norm whose gradient at zero is zero, not NaN."""
    return torch.sqrt(vectors.square().sum(-1) + 1e-16)


def _outlying(miss: Tensor) -> Tensor:
    """Square of a distance in spacings, going over into a line of the same slope (pseudo-Huber).

    A plain square let a few outliers of each step set the direction of its clipped gradient.
    """
    bend = 0.1
    return 2.0 * bend * bend * (torch.sqrt(1.0 + (miss / bend).square()) - 1.0)


def _unoriented(normals: Tensor, truth: Tensor) -> Tensor:
    """``min(|n - m|, |n + m|)`` of unit vectors: about the angle between them, in radians."""
    return torch.sqrt(2.0 - 2.0 * (normals * truth).sum(-1).abs().clamp(max=1.0) + 1e-6)
