# SPDX-License-Identifier: Apache-2.0
"""The paper's joint loss: Chamfer distance, coarse and refined normals (section 3.5).

The paper prints the unoriented normal loss as the *max* of ``|n - m|^2`` and ``|n + m|^2``. Only
the *min* is an unoriented difference: the max is smallest for normals at a right angle to the true
one. The min is taken.

The paper prints sums over points in the normal losses and a mean in the Chamfer distance. Means
are taken in all three, so that their weights 100, 1, 1 do not depend on N and R.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pugeo_model.geometry.neighbours import knn
from pugeo_model.network.patch_networks.output import PatchOutput
from pugeo_model.training.patches.settings import PatchWeights

__all__ = ["PatchLoss", "chamfer", "repulsion", "unoriented"]


def _length(vectors: Tensor) -> Tensor:
    """Euclidean norm along the last dimension whose gradient at zero is zero, not NaN."""
    return torch.sqrt(vectors.square().sum(-1) + 1e-16)


def _take(values: Tensor, rows: Tensor) -> Tensor:
    """``(B, n, 3)`` at rows ``(B, m)`` -> ``(B, m, 3)``."""
    return values.gather(1, rows.unsqueeze(-1).expand(-1, -1, 3))


def _nearest(points: Tensor, others: Tensor, count: int) -> Tensor:
    """Rows of the ``count`` nearest of ``others`` ``(B, m, 3)`` to each point, ``(B, n, count)``.

    Trees are faster than all distances from some hundred points on, and need no memory for them.
    """
    # A tree takes no infinite values; a step whose gradient is not finite is left out later.
    queries, places = (
        torch.nan_to_num(each.detach(), 0.0, 0.0, 0.0).numpy() for each in (points, others)
    )
    rows = [knn(cKDTree(b), a, count)[1] for a, b in zip(queries, places, strict=True)]
    return torch.from_numpy(np.stack(rows).astype(np.int64))


def chamfer(points: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """L_CD: the sum of both mean distances (not squared) to the nearest point of the other set.

    Args:
        points: ``(B, n, 3)`` predicted.
        truth: ``(B, m, 3)``.

    Returns:
        The scalar, and the row of the nearest true point ``phi`` of each prediction, ``(B, n)``.
    """
    phi, psi = _nearest(points, truth, 1)[..., 0], _nearest(truth, points, 1)[..., 0]
    there = _length(points - _take(truth, phi)).mean()
    back = _length(truth - _take(points, psi)).mean()
    return there + back, phi


def unoriented(normals: Tensor, truth: Tensor) -> Tensor:
    """``min(|n - m|^2, |n + m|^2)`` along the last dimension."""
    there = (normals - truth).square().sum(-1)
    return torch.minimum(there, (normals + truth).square().sum(-1))


def repulsion(points: Tensor, neighbours: int = 5, reach: float = 0.03) -> Tensor:
    """PU-Net's repulsion: mean of ``-d exp(-d^2 / h^2)`` over the nearest points (Yu et al. 2018).

    Args:
        points: ``(B, n, 3)``.
        neighbours: nearest points of each that push.
        reach: h, in patch radii.
    """
    near = _nearest(points, points, min(neighbours, points.shape[1]))[..., 1:]
    others = _take(points, near.flatten(1)).unflatten(1, near.shape[1:])
    apart = _length(points.unsqueeze(2) - others)
    return (-apart * torch.exp(-apart.square() / reach**2)).mean()


class PatchLoss:
    """Joint loss of a batch (eq. 14): ``alpha L_CD + beta L_coarse + gamma L_refined``.

    Args:
        weights: of the terms. Those of normals are left out where the network predicts none.
    """

    def __init__(self, weights: PatchWeights | None = None) -> None:
        self.weights = weights or PatchWeights()

    def __call__(
        self, output: PatchOutput, normals: Tensor, dense: Tensor, dense_normals: Tensor
    ) -> tuple[Tensor, dict[str, float]]:
        """Scalar loss and its parts.

        Args:
            output: predicted patches.
            normals: ``(B, N, 3)`` true normals of the input points.
            dense: ``(B, R N, 3)`` true points.
            dense_normals: ``(B, R N, 3)`` their normals.
        """
        w = self.weights
        points = output.points.flatten(1, 2)
        distance, phi = chamfer(points, dense)
        parts = {"chamfer": distance}
        total = w.chamfer * distance
        if output.coarse_normals is not None and w.coarse_normal:
            parts["coarse_normal"] = unoriented(output.coarse_normals, normals).mean()
            total = total + w.coarse_normal * parts["coarse_normal"]
        if output.normals is not None and w.refined_normal:
            refined = unoriented(output.normals.flatten(1, 2), _take(dense_normals, phi))
            parts["refined_normal"] = refined.mean()
            total = total + w.refined_normal * parts["refined_normal"]
        if w.repulsion:
            parts["repulsion"] = repulsion(points)
            total = total + w.repulsion * parts["repulsion"]
        return total, {name: float(part.detach()) for name, part in parts.items()}
