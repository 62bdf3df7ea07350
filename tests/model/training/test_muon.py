# SPDX-License-Identifier: Apache-2.0
"""Muon in float32."""

import pytest
import torch
from torch import nn

from pugeo_model.training.muon import Muon, orthogonalised


@pytest.mark.parametrize("shape", [(40, 40), (32, 96), (96, 32)])
def test_singular_values_are_near_one(shape):
    """Singular vectors stay, singular values become nearly equal."""
    matrix = torch.randn(*shape, generator=torch.Generator().manual_seed(0))
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    inside = left.T @ orthogonalised(matrix) @ right.T
    found = inside.diagonal()
    assert values.max() > 3 * values.min()
    assert found[values > 0.1 * values.max()].min() > 0.6
    assert found.max() < 1.3
    assert (inside - found.diag()).abs().max() < 1e-4


def test_equal_to_torch():
    """Five steps are those of torch's Muon, but for its rounding to eight bits."""
    ours, theirs = nn.Linear(48, 80, bias=False), nn.Linear(48, 80, bias=False)
    theirs.load_state_dict(ours.state_dict())
    start = ours.weight.detach().clone()
    inputs = torch.randn(64, 48, generator=torch.Generator().manual_seed(1))
    optimizers = [
        Muon(ours.parameters(), 0.02),
        torch.optim.Muon(
            [theirs.weight], lr=0.02, weight_decay=0.01, adjust_lr_fn="match_rms_adamw"
        ),
    ]
    for _ in range(5):
        for layer, optimizer in zip((ours, theirs), optimizers, strict=True):
            optimizer.zero_grad()
            (layer(inputs).sin() - 0.3).square().mean().backward()
            optimizer.step()
    moved = (theirs.weight - start).norm()
    assert (ours.weight - theirs.weight).norm() < 0.05 * moved


def test_a_matrix_without_gradient_stays():
    """It has no state either."""
    layer = nn.Linear(40, 40, bias=False)
    before = layer.weight.detach().clone()
    muon = Muon(layer.parameters(), 0.1)
    muon.step()
    assert torch.equal(layer.weight, before)
    assert not muon.state
