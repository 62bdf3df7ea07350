# SPDX-License-Identifier: Apache-2.0
"""The training loop."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from pugeo_model.errors import BadOptionError
from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import Batches
from pugeo_model.training.trainer import Recipe, Trainer, learning_rate


def test_the_learning_rate_has_three_phases():
    """It rises, is constant, and falls to zero."""
    recipe = Recipe(steps=1000, warmup=100, cooldown=0.2, rate=1.0)
    assert learning_rate(recipe, 0) == pytest.approx(0.01)
    assert learning_rate(recipe, 500) == 1.0
    assert learning_rate(recipe, 900) == pytest.approx(0.5)
    assert learning_rate(recipe, 999) == pytest.approx(0.005)


@pytest.mark.slow
def test_the_loss_falls(shapes, small, tmp_path):
    """Forty steps on one shape lower the loss by a fifth or more."""
    trainer = Trainer(shapes, Recipe(small, steps=40, warmup=5, rate=4e-3), tmp_path)
    batches = Batches(shapes, Mix(), 0, 40)
    losses = []
    for trainer.step in range(40):
        losses.append(trainer._train(batches[trainer.step % 4])["loss"])
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:4])


def test_a_gradient_that_is_not_finite_changes_nothing(shapes, small, tmp_path, monkeypatch):
    """A step with a NaN gradient is skipped."""
    trainer = Trainer(shapes, Recipe(small, steps=2, warmup=1), tmp_path)
    before = {name: value.clone() for name, value in trainer.net.state_dict().items()}
    batch = Batches(shapes, Mix(), 0, 2)[0]
    loss = trainer.loss

    def not_finite(net, count, samples, rng):
        total, parts = loss(net, count, samples, rng)
        return total * float("nan"), parts

    monkeypatch.setattr(trainer, "loss", not_finite)
    assert not np.isfinite(trainer._train(batch)["gradient"])
    for name, value in trainer.net.state_dict().items():
        torch.testing.assert_close(value, before[name])


@pytest.mark.slow
def test_the_log_has_a_line_for_each_report(shapes, small, tmp_path):
    """Losses of training and validation are logged every few steps; progress is reported."""
    recipe = Recipe(small, steps=3, warmup=1)
    trainer = Trainer(shapes, recipe, tmp_path, shapes)
    reports: list[tuple[int, dict[str, float]]] = []
    ticks: list[int] = []
    trainer.run(2, lambda step, line: reports.append((step, line)), ticks.append)
    assert ticks == [1, 2, 3]
    assert [step for step, _ in reports] == [2, 3]
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["2", "3"]
    for (_, line), row in zip(reports, rows, strict=True):
        assert {"loss", "p2f", "val_loss", "val_p2f", "rate", "hours"} <= set(line)
        assert float(row["val_loss"]) == pytest.approx(line["val_loss"], rel=1e-5)


def test_validation_is_reproducible(shapes, small, tmp_path):
    """It uses fixed patches and does not change the network."""
    trainer = Trainer(shapes, Recipe(small), tmp_path, shapes)
    assert trainer.validate(2) == trainer.validate(2) != {}
    assert trainer.net.training
    assert Trainer(shapes, Recipe(small), tmp_path / "other").validate() == {}


def test_weights_of_another_architecture(shapes, small, tmp_path):
    """Starting from weights of another architecture is an error."""
    recipe = replace(Recipe(small), start="standard")
    with pytest.raises(BadOptionError, match="architecture"):
        Trainer(shapes, recipe, tmp_path)
