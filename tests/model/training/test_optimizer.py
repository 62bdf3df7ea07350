# SPDX-License-Identifier: Apache-2.0
"""Muon and AdamW as one optimizer."""

import copy

import pytest
import torch
from torch import nn

from pugeo_model.training.optimizer import Optimizer


def net() -> nn.Module:
    """Layers of both kinds: narrow ends, a wide middle."""
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(4, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1)
    )


def steps(model: nn.Module, optimizer: Optimizer, count: int) -> list[float]:
    """Losses of a regression."""
    inputs = torch.linspace(-1, 1, 64).unsqueeze(1) ** torch.arange(1, 5)
    targets = torch.sin(3 * inputs[:, :1])
    losses = []
    for _ in range(count):
        loss = (model(inputs) - targets).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step(0.01)
        losses.append(float(loss.detach()))
    return losses


def test_the_inner_matrix_is_trained_by_muon():
    """Muon has the wide matrix only; AdamW has all other parameters."""
    model = net()
    adamw, muon = Optimizer(model, 0.01, 0.0)._parts
    inner = [p for group in muon.param_groups for p in group["params"]]
    others = [p for group in adamw.param_groups for p in group["params"]]
    assert [p.shape for p in inner] == [(64, 64)]
    assert len(inner) + len(others) == len(list(model.parameters()))


def test_a_network_without_inner_matrices():
    """AdamW alone trains a narrow network."""
    model = nn.Linear(4, 1)
    assert len(Optimizer(model, 0.01, 0.0)._parts) == 1


def test_it_lowers_a_loss():
    """A regression becomes more accurate."""
    model = net()
    losses = steps(model, Optimizer(model, 0.01, 0.0), 60)
    assert losses[-1] < 0.2 * losses[0]


def test_the_rate_is_that_of_the_step():
    """A step with rate zero changes nothing."""
    model = net()
    optimizer = Optimizer(model, 0.01, 0.0)
    steps(model, optimizer, 1)
    before = [p.clone() for p in model.parameters()]
    optimizer.step(0.0)
    assert all(torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))


def test_gradients_are_reset():
    """No parameter has a gradient after a reset."""
    model = net()
    optimizer = Optimizer(model, 0.01, 0.0)
    steps(model, optimizer, 1)
    optimizer.zero_grad()
    assert all(p.grad is None for p in model.parameters())


@pytest.mark.parametrize("restore", [True, False])
def test_the_state_is_part_of_a_checkpoint(restore):
    """With the state restored, training continues exactly; without it, differently."""
    one = net()
    first = Optimizer(one, 0.01, 0.0)
    steps(one, first, 5)
    two = net()
    two.load_state_dict(one.state_dict())
    second = Optimizer(two, 0.01, 0.0)
    if restore:
        # A copy, as a checkpoint is: torch's optimizers share the tensors of a state.
        second.load_state_dict(copy.deepcopy(first.state_dict()))
    assert (steps(one, first, 3) == steps(two, second, 3)) is restore
