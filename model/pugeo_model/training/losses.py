# SPDX-License-Identifier: Apache-2.0
"""Joint loss: coverage, distance to the surface, coarse and refined normals, blended charts.

The paper weights Chamfer distance and the two normal losses 100, 1, 1 (eq. 12). The Chamfer
distance to a random sample of equal size has a random lower bound above zero. Its two halves are
replaced by terms without such a bound: *coverage*, the mean squared distance from the true surface
to the nearest prediction, and *P2F*, the exact distance from a prediction to the mesh. All lengths
are in local spacings.

The paper prints the unoriented normal loss with the *max* over both signs of the true normal
(eq. 10, 11); only the *min* is an unoriented difference. Its length is used, not its square, since
squares of the unavoidable large errors at creases would dominate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pugeo_model.expected_error import FLOOR
from pugeo_model.mesh.distance import MeshDistance
from pugeo_model.network.neighbourhoods import stack_patches
from pugeo_model.network.projection import blend
from pugeo_model.network.pugeo import Charts, PUGeoNet, evaluate
from pugeo_model.resample.atlas import BLENDED_CHARTS
from pugeo_model.training.batches import Sample
from pugeo_model.training.corpus import Shape

__all__ = ["JointLoss", "LossWeights"]

_QUERIES = 3  # points per chart at which it is blended with others


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss, and of noisy patches.

    Attributes:
        coverage: of ``z + z^2 / (1 + z)`` with ``z = R d^2 / s^2`` at samples of the true
            surface: holes count twice, but unreachable holes of random inputs do not dominate.
        p2f: of the distance to the surface; ``3 R`` times its square, linear beyond 0.1 spacings,
            is added for outliers.
        coarse_normal: of the coarse normal ``T (0, 0, 1)``.
        refined_normal: of the final normal.
        blended: of P2F and normals of blended charts; the weight of the latter falls with
            ``refined_normal`` below 1/6, so that without it no term supervises normals.
        confidence: of the regression of the log error of each chart.
        noise: a patch has the weight ``1 / (1 + noise * sigma / s)``, since the loss of noisy
            patches stays large and would dominate.
    """

    coverage: float = 1.0
    p2f: float = 3.0
    coarse_normal: float = 0.2
    refined_normal: float = 0.5
    blended: float = 3.0
    confidence: float = 0.05
    noise: float = 2.0


@dataclass(frozen=True, eq=False)
class _Batch:
    """Inputs of the loss for all patches, concatenated.

    Attributes:
        core: number of charts of each patch.
        start: ``(patches,)`` first row of each patch.
        points, axes, spacing, quadric: of the ``n`` charts, as in ``Patch`` and ``Frames``.
        weight: ``(n,)`` weight by the noise of the patch.
        truths: ``(G, 3)`` samples of the true surfaces.
        owners: ``(G, 6)`` rows of the charts that may cover each sample.
    """

    core: list[int]
    start: np.ndarray
    points: Tensor
    axes: Tensor
    spacing: Tensor
    quadric: Tensor
    weight: Tensor
    truths: Tensor
    owners: Tensor

    @classmethod
    def of(cls, samples: Sequence[Sample], noise: float) -> "_Batch":
        """Concatenate samples; ``noise`` as in `LossWeights`."""
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
            weight=_rows([np.full(n, 1 / (1 + noise * s.noise)) for s, n in each]),
            truths=_rows([sample.truths for sample in samples]),
            owners=torch.from_numpy(np.concatenate(owners)),
        )


class JointLoss:
    """Loss of a batch.

    Args:
        shapes: the corpus that ``Sample.shape`` indexes.
        weights: weights of the terms.
    """

    def __init__(self, shapes: Sequence[Shape], weights: LossWeights | None = None) -> None:
        self.shapes = shapes
        self.weights = weights or LossWeights()
        self._distances: dict[int, MeshDistance] = {}

    def __call__(
        self, net: PUGeoNet, count: int, samples: Sequence[Sample], rng: np.random.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        """Compute the scalar loss and its terms, each a mean over the batch.

        Args:
            net: the network.
            count: samples per chart.
            samples: the patches.
            rng: draws the points at which charts are blended.
        """
        w = self.weights
        batch = _Batch.of(samples, w.noise)
        points, axes, spacing, weight = batch.points, batch.axes, batch.spacing, batch.weight

        charts, uv = net(stack_patches([sample.patch for sample in samples]), batch.quadric, count)
        local, normals, log_error = evaluate(net.surface, charts, uv)
        cloud = points[:, None] + spacing[:, None, None] * (local @ axes)
        world_normals = normals @ axes
        coarse = (charts.T[..., 2].unsqueeze(1) @ axes).squeeze(1)

        foot, true_normal = self._project(samples, batch.core, cloud.detach())
        distance = _length(cloud - foot) / spacing[:, None]
        angle = _unoriented(world_normals, true_normal)
        coarse_angle = _unoriented(coarse.unsqueeze(1), true_normal)
        fraction = weight[:, None] / weight.sum() / count

        # Samples of the true surface against the charts that may cover them.
        truths, owners = batch.truths, batch.owners
        with torch.no_grad():
            squared = (cloud[owners] - truths[:, None, None]).square().sum(-1).flatten(1)
            best = squared.argmin(dim=1)
            owner = owners.gather(1, (best // count).unsqueeze(1)).squeeze(1)
        nearest = cloud[owner, best % count]
        z = count * (nearest - truths).square().sum(-1) / spacing[owner].square()
        truth_fraction = weight[owner] / weight[owner].sum()

        log_difference = (log_error - torch.log(distance.detach() + FLOOR)).abs()
        parts = {
            "coverage": (truth_fraction * (z + z.square() / (1.0 + z))).sum(),
            "p2f": (fraction * distance).sum(),
            "outliers": (fraction * _pseudo_huber(distance)).sum(),
            "coarse_normal": (fraction * coarse_angle).sum(),
            "refined_normal": (fraction * angle).sum(),
            "confidence": (fraction * log_difference).sum(),
        }
        parts |= self._blended(net, charts, samples, batch, cloud, rng)
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
        batch: "_Batch",
        cloud: Tensor,
        rng: np.random.Generator,
    ) -> dict[str, Tensor]:
        """Terms of blended charts, at two kinds of points.

        Near samples of charts, where charts are blended in inference; and on the true surface,
        where points must not move, also on a ridge, where the mean of the charts of both sides
        lies below the surface.
        """
        points, axes, spacing, weight = batch.points, batch.axes, batch.spacing, batch.weight
        start, truths, owners = batch.start, batch.truths, batch.owners
        near = np.concatenate([s.near + b for s, b in zip(samples, start, strict=True)])
        ends = np.repeat(start + np.array(batch.core), batch.core)
        whole = torch.from_numpy(np.flatnonzero((near[:, :8] < ends[:, None]).all(axis=1)))
        pick = torch.from_numpy(rng.integers(cloud.shape[1], size=(len(whole), _QUERIES)))
        jitter = torch.from_numpy(
            rng.normal(size=(len(whole), _QUERIES, 3), scale=0.1).astype(np.float32)
        )
        queries = cloud.detach()[whole[:, None], pick] + jitter * spacing[whole, None, None]
        candidates = torch.cat([whole[:, None], torch.from_numpy(near)[whole, :8]], dim=1)
        squared = (queries[:, :, None] - points[candidates][:, None]).square().sum(-1)
        ranks = squared.topk(BLENDED_CHARTS, dim=-1, largest=False).indices
        chosen = candidates.unsqueeze(1).expand(-1, _QUERIES, -1).gather(2, ranks)
        on_surface = torch.from_numpy(rng.permutation(len(truths))[: len(whole)])
        queries = torch.cat([queries.reshape(-1, 3), truths[on_surface]])
        chosen = torch.cat(
            [chosen.reshape(-1, BLENDED_CHARTS), owners[on_surface, :BLENDED_CHARTS]]
        )
        owner = torch.cat([whole.repeat_interleave(_QUERIES), owners[on_surface, 0]])
        # Sorted by patch, since each patch is projected onto its own mesh.
        patch = torch.from_numpy(np.searchsorted(start, owner.numpy(), side="right") - 1)
        order = torch.argsort(patch, stable=True)
        queries, chosen, owner = queries[order], chosen[order], owner[order]
        fixed = (order >= len(order) - len(on_surface)).unsqueeze(1)
        flat = chosen.flatten()
        picked = Charts(charts.T[flat], charts.code[flat], charts.lift[flat], charts.quadric[flat])
        offsets = queries[:, None] - points[chosen]
        step, normal, _, (steps, log_errors) = blend(
            net.surface, picked, offsets, axes[chosen], spacing[chosen]
        )
        projected = queries + step
        counts = torch.bincount(patch, minlength=len(samples)).tolist()
        foot, true_normal = self._project(samples, counts, projected.detach())
        scale = spacing[owner]
        fraction = weight[owner] / weight[owner].sum()
        distance = _length(projected - torch.where(fixed, queries, foot)) / scale
        angle = _unoriented(normal, true_normal)
        # The distance of a single chart is measured to the tangent plane at the foot point, which
        # is accurate enough and saves a search.
        single = queries[:, None] + steps - foot[:, None]
        single = (single * true_normal[:, None]).sum(-1).abs() / scale[:, None]
        squared = offsets.square().sum(-1) / spacing[chosen].square()
        nearby = torch.exp(-squared / 0.64) / BLENDED_CHARTS
        log_difference = (log_errors - torch.log(single.detach() + FLOOR)).abs().mean(dim=1)
        outliers = cloud.shape[1] * _pseudo_huber(distance)
        return {
            "blended_p2f": (fraction * (distance + outliers)).sum(),
            "blended_normal": (fraction * angle).sum(),
            "chart_p2f": (fraction * (nearby * single).sum(dim=1)).sum(),
            "chart_confidence": (fraction * log_difference).sum(),
        }

    def _project(
        self, samples: Sequence[Sample], counts: list[int], cloud: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Nearest points and face normals on the mesh of each sample, in the shape of ``cloud``."""
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
    """Concatenate arrays to a float32 tensor."""
    return torch.from_numpy(np.concatenate(arrays).astype(np.float32, copy=False))


def _length(vectors: Tensor) -> Tensor:
    """Euclidean norm whose gradient at zero is zero and not NaN."""
    return torch.sqrt(vectors.square().sum(-1) + 1e-16)


def _pseudo_huber(distance: Tensor) -> Tensor:
    """Pseudo-Huber loss: about the square up to 0.1 spacings, linear beyond.

    With a square, few outliers would determine the direction of the clipped gradient.
    """
    delta = 0.1
    return 2.0 * delta * delta * (torch.sqrt(1.0 + (distance / delta).square()) - 1.0)


def _unoriented(normals: Tensor, truth: Tensor) -> Tensor:
    """``min(|n - m|, |n + m|)`` of unit vectors (eq. 10, 11), about their angle in radians."""
    return torch.sqrt(2.0 - 2.0 * (normals * truth).sum(-1).abs().clamp(max=1.0) + 1e-6)
