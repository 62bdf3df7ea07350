# SPDX-License-Identifier: Apache-2.0
"""Training loop: batches, optimizer, learning rate, checkpoints, log."""

import csv
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from pugeo_model.malloc import bound_compiled_products, keep_freed_memory
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture
from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import Batches
from pugeo_model.training.corpus import Shape
from pugeo_model.training.losses import JointLoss, LossWeights
from pugeo_model.training.optimizer import Optimizer
from pugeo_model.training.patches.settings import PatchSettings
from pugeo_model.weights import start_from

__all__ = ["Recipe", "Trainer", "learning_rate"]


@dataclass(frozen=True)
class Recipe:
    """All settings of a training run besides the corpus.

    Attributes:
        architecture: the network.
        mix: probabilities of the kinds of input.
        weights: weights of the loss.
        steps: number of steps. A larger value continues the constant phase of a resumed run.
        rate: learning rate of both optimizers.
        warmup: steps of linear increase of the learning rate.
        cooldown: fraction of the steps, at the end, over which the rate falls to zero.
        decay: weight decay of AdamW.
        clip: largest norm of the gradient.
        seed: seed of weights, batches and loss.
        threads: torch threads.
        start: weights to start from, a released name or a ``.safetensors`` file of this
            architecture; random if ``None``.
        patches: settings of a network that upsamples whole patches; ``mix`` and ``weights`` are
            not used then. ``None`` for networks that predict charts.
    """

    architecture: Architecture = field(default_factory=Architecture)
    mix: Mix = field(default_factory=Mix)
    weights: LossWeights = field(default_factory=LossWeights)
    steps: int = 85_500
    rate: float = 2e-3
    warmup: int = 200
    cooldown: float = 0.45
    decay: float = 1e-4
    clip: float = 1.0
    seed: int = 0
    threads: int = 1
    start: str | None = None
    patches: PatchSettings | None = None

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON-able dictionary, for the model card."""
        raw = {**asdict(self), "architecture": self.architecture.to_json()}
        if self.start is None:
            del raw["start"]
        if self.patches is None:
            del raw["patches"]
        else:
            del raw["mix"], raw["weights"]
            return raw
        for kind in ("sensors", "dense"):
            # Weights that were trained before there were sensors have no such numbers.
            if not raw["mix"][kind]:
                del raw["mix"][kind]
        return raw


def learning_rate(recipe: Recipe, step: int) -> float:
    """Return the learning rate of a step: warm-up, constant, then linear decrease to zero.

    The constant phase allows a run to be shortened or extended.
    """
    constant_end = int(recipe.steps * (1.0 - recipe.cooldown))
    warmup = min(1.0, (step + 1) / recipe.warmup)
    remaining = (recipe.steps - step) / max(recipe.steps - constant_end, 1)
    return recipe.rate * warmup * (1.0 if step < constant_end else remaining)


class Trainer:
    """A training run in a folder; writes ``log.csv`` and ``checkpoint.pt``, which resumes exactly.

    Args:
        shapes: training shapes.
        recipe: settings of the run.
        folder: folder of the run; an existing checkpoint there is resumed.
        validation: shapes for the validation loss, which are not trained on.

    Attributes:
        net: the network.
        step: number of completed steps.
        hours: training time so far.
        stopping: set it to end ``run`` after the current step, with a checkpoint.
    """

    def __init__(
        self,
        shapes: list[Shape],
        recipe: Recipe,
        folder: Path,
        validation: list[Shape] | None = None,
    ) -> None:
        torch.set_num_threads(recipe.threads)
        bound_compiled_products()
        keep_freed_memory()
        torch.manual_seed(recipe.seed)
        self.recipe, self.folder = recipe, folder
        self.shapes, self.validation = shapes, validation or []
        self._build()
        self.step = 0
        self.stopping = False
        self.hours = 0.0

        folder.mkdir(parents=True, exist_ok=True)
        if self._checkpoint.exists():
            self._resume()
        elif recipe.start is not None:
            start_from(self.net, recipe.start)

    def _build(self) -> None:
        """Create the network, its optimizer and its loss."""
        self.net: Any = build_network(self.recipe.architecture)
        self.optimizer = Optimizer(self.net, self.recipe.rate, self.recipe.decay)
        self.loss: Any = JointLoss(self.shapes, self.recipe.weights)

    def _batches(self) -> Dataset[Any]:
        """Return the training batches by step."""
        recipe = self.recipe
        return Batches(self.shapes, recipe.mix, recipe.seed, recipe.steps)

    @property
    def _checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    def run(
        self,
        every: int = 500,
        report: Callable[[int, dict[str, float]], None] | None = None,
        tick: Callable[[int], None] | None = None,
    ) -> None:
        """Train to the end of the recipe.

        Args:
            every: steps between checkpoints, log lines and validations.
            report: called with the step and the values of each log line.
            tick: called after each step.
        """
        recipe = self.recipe
        loader = DataLoader(
            self._batches(),
            batch_size=None,
            sampler=range(self.step, recipe.steps),
            num_workers=1,
            prefetch_factor=4,
            multiprocessing_context="fork",
        )
        sums: dict[str, float] = {}
        start = time.monotonic()
        since = self.step
        for batch in loader:
            parts = self._train(batch)
            for name, value in parts.items():
                sums[name] = sums.get(name, 0.0) + value
            self.step += 1
            if tick:
                tick(self.step)
            if self.step % every == 0 or self.step == recipe.steps or self.stopping:
                self.hours += (time.monotonic() - start) / 3600
                line = {name: value / (self.step - since) for name, value in sums.items()}
                line |= self.validate()
                line |= {"rate": learning_rate(recipe, self.step - 1), "hours": self.hours}
                self._log(line)
                self._save()
                if report:
                    report(self.step, line)
                sums, since, start = {}, self.step, time.monotonic()
            if self.stopping:
                break

    def validate(self, steps: int = 12) -> dict[str, float]:
        """Compute the loss on fixed patches of the validation shapes, clean and even input.

        Args:
            steps: number of batches.

        Returns:
            Means of the loss and of its terms, by name; empty without validation shapes.
        """
        if not self.validation:
            return {}
        loss = JointLoss(self.validation, self.recipe.weights)
        clean = Mix(noisy=0, random=0, ramp=0, cut=0, lines=0)
        batches = Batches(self.validation, clean, seed=1, steps=steps)
        sums: dict[str, float] = {}
        self.net.eval()
        with torch.no_grad():
            for step in range(steps):
                count, samples = batches[step]
                total, parts = loss(self.net, count, samples, np.random.default_rng(step))
                for name, value in {"loss": float(total), **parts}.items():
                    sums[f"val_{name}"] = sums.get(f"val_{name}", 0.0) + value / steps
        self.net.train()
        return sums

    def _losses(self, batch: Any) -> tuple[Tensor, dict[str, float]]:
        """Compute the loss of a batch and its terms."""
        count, samples = batch
        rng = np.random.default_rng([self.recipe.seed, self.step, 1])
        total, parts = self.loss(self.net, count, samples, rng)
        return total, parts

    def _train(self, batch: Any) -> dict[str, float]:
        """Train one step; returns the loss, its terms and the norm of the gradient."""
        total, parts = self._losses(batch)
        self.optimizer.zero_grad()
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.recipe.clip)
        if torch.isfinite(norm):
            self.optimizer.step(learning_rate(self.recipe, self.step))
        return {"loss": float(total.detach()), **parts, "gradient": float(norm)}

    def _save(self) -> None:
        state = {
            "recipe": self.recipe.to_json(),
            "net": self.net.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "hours": self.hours,
        }
        partial = self._checkpoint.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(self._checkpoint)

    def _resume(self) -> None:
        state = torch.load(self._checkpoint, weights_only=True)
        self.net.load_state_dict(state["net"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self.hours = state["step"], state["hours"]

    def _log(self, line: dict[str, float]) -> None:
        path = self.folder / "log.csv"
        fresh = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, ["step", *line])
            if fresh:
                writer.writeheader()
            writer.writerow({"step": self.step, **{k: f"{v:.6g}" for k, v in line.items()}})
