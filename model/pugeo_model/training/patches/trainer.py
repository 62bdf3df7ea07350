# SPDX-License-Identifier: Apache-2.0
"""The trainer of patch networks: the loop of :class:`Trainer` with the paper's data and loss."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from pugeo_model.network.build import build_network
from pugeo_model.training.corpus import Shape, default_cache
from pugeo_model.training.optimizer import Optimizer
from pugeo_model.training.patches.batches import PatchBatches, TrainingBatch
from pugeo_model.training.patches.corpus import load_pairs
from pugeo_model.training.patches.losses import PatchLoss
from pugeo_model.training.patches.settings import Augmentation, PatchSettings
from pugeo_model.training.trainer import Trainer

__all__ = ["Adam", "PatchTrainer"]

_VALIDATION_SEED = 1


class Adam(Optimizer):
    """Adam for all parameters, as the paper trains (section 4.1).

    Args:
        net: the network.
        rate: learning rate.
        decay: L2 penalty; the paper names none.
    """

    def __init__(self, net: nn.Module, rate: float, decay: float) -> None:
        self._parts = [torch.optim.Adam(net.parameters(), lr=rate, weight_decay=decay, fused=True)]


class PatchTrainer(Trainer):
    """One training run of a patch network in one folder; see :class:`Trainer`."""

    def _build(self) -> None:
        self.net = build_network(self.recipe.architecture)
        self.optimizer = Adam(self.net, self.recipe.rate, self.recipe.decay)
        self.loss = PatchLoss(self._settings.weights)

    @property
    def _settings(self) -> PatchSettings:
        assert self.recipe.patches is not None
        return self.recipe.patches

    def _batches(self) -> Dataset[Any]:
        return self._dataset(self.shapes, self._settings.augmentation, self.recipe.seed)

    def _dataset(self, shapes: list[Shape], amounts: Augmentation, seed: int) -> PatchBatches:
        settings, ratio = self._settings, self.net.ratio
        pairs = load_pairs(shapes, ratio, default_cache())
        return PatchBatches(pairs, ratio, settings.size, settings.batch, amounts, seed)

    def _losses(self, batch: TrainingBatch) -> tuple[Tensor, dict[str, float]]:
        points, normals, dense, dense_normals = (
            torch.from_numpy(part)
            for part in (batch.points, batch.normals, batch.dense, batch.dense_normals)
        )
        total, parts = self.loss(self.net(points), normals, dense, dense_normals)
        return total, parts

    def validate(self, steps: int = 12) -> dict[str, float]:
        """Parts of the loss on fixed patches of the validation shapes, turned but not perturbed."""
        if not self.validation:
            return {}
        clean = Augmentation(scale=0.0, jitter=0.0)
        batches = self._dataset(self.validation, clean, _VALIDATION_SEED)
        sums: dict[str, float] = {}
        self.net.eval()
        with torch.no_grad():
            for step in range(steps):
                total, parts = self._losses(batches[step])
                for name, value in {"loss": float(total), **parts}.items():
                    sums[f"val_{name}"] = sums.get(f"val_{name}", 0.0) + value / steps
        self.net.train()
        return sums
