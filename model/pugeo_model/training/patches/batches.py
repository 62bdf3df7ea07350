# SPDX-License-Identifier: Apache-2.0
"""Batches of patches: N points and the R N points of the dense sample around the same seed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.utils.data import Dataset

from pugeo_model.geometry.neighbours import knn
from pugeo_model.geometry.overlapping import normalise_patch
from pugeo_model.training.patches.corpus import Pair
from pugeo_model.training.patches.settings import Augmentation

__all__ = ["PatchBatches", "TrainingBatch"]


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """A batch of training patches, float32, lengths in patch radii.

    Attributes:
        points: ``(B, N, 3)`` input.
        normals: ``(B, N, 3)`` true unit normals of the input points.
        dense: ``(B, R N, 3)`` true dense points.
        dense_normals: ``(B, R N, 3)`` their unit normals.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    dense: NDArray[np.float32]
    dense_normals: NDArray[np.float32]


class PatchBatches(Dataset[TrainingBatch]):
    """Batch number ``step``, drawn from ``(seed, step)`` alone, so that training resumes exactly.

    Args:
        pairs: sparse and dense samples of every shape.
        ratio: R.
        patch_size: N.
        batch: B, patches a step.
        augmentation: of every patch.
        seed: of everything drawn.
    """

    def __init__(
        self,
        pairs: list[Pair],
        ratio: int,
        patch_size: int,
        batch: int,
        augmentation: Augmentation,
        seed: int,
    ) -> None:
        self.pairs, self.ratio, self.patch_size = pairs, ratio, patch_size
        self.batch, self.augmentation, self.seed = batch, augmentation, seed
        self._trees = [
            tuple(cKDTree(part[:, :3].astype(np.float64)) for part in (pair.sparse, pair.dense))
            for pair in pairs
        ]

    def __getitem__(self, step: int) -> TrainingBatch:
        """Return batch ``step``."""
        rng = np.random.default_rng([self.seed, step])
        drawn = [self._draw(rng) for _ in range(self.batch)]
        return TrainingBatch(*(np.stack(parts) for parts in zip(*drawn, strict=True)))

    def _draw(self, rng: np.random.Generator) -> tuple[NDArray[np.float32], ...]:
        shape = int(rng.integers(len(self.pairs)))
        pair, (sparse_tree, dense_tree) = self.pairs[shape], self._trees[shape]
        seed = pair.sparse[rng.integers(len(pair.sparse)), :3][None].astype(np.float64)
        near = knn(sparse_tree, seed, self.patch_size)[1][0]
        around = knn(dense_tree, seed, self.ratio * self.patch_size)[1][0]
        sparse, dense = pair.sparse[near], pair.dense[around]
        points, centre, radius = normalise_patch(sparse[:, :3])
        truth = (dense[:, :3] - centre) / radius
        amounts = self.augmentation
        turn = Rotation.random(rng=rng).as_matrix() if amounts.rotate else np.eye(3)
        turn = turn.T.astype(np.float32)
        size = np.float32(rng.uniform(1.0 - amounts.scale, 1.0 + amounts.scale))
        noise = np.clip(rng.normal(size=points.shape), -3.0, 3.0).astype(np.float32)
        moved = points @ turn * size + np.float32(amounts.jitter) * noise
        return moved, sparse[:, 3:] @ turn, truth @ turn * size, dense[:, 3:] @ turn
