# SPDX-License-Identifier: Apache-2.0
import copy

import pytest
import torch

from pugeo_model.network import linear
from pugeo_model.network.linear import Linear, Rectified, freeze


@pytest.fixture
def net():
    """Layers with and without a bias, of widths that no register likes."""
    torch.manual_seed(0)
    return torch.nn.Sequential(Rectified(5, 33), Rectified(33, 16), Linear(16, 7, bias=False))


def test_a_served_layer_says_what_it_says_in_training(net, monkeypatch):
    """One pass of oneDNN and torch's three passes in bfloat16 agree, for rows in any shape."""
    if not linear._there():
        pytest.skip("oneDNN has no bfloat16 product for this processor")
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: True)
    rows = torch.randn(12, 50, 5)
    plain = copy.deepcopy(net)
    freeze(net)
    with torch.inference_mode():
        served = net(rows)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(served, plain(rows))
    assert served.dtype == torch.bfloat16
    assert served.shape == (12, 50, 7)


def test_a_layer_that_serves_can_be_trained_on(net, monkeypatch):
    """With gradients the weights count as they are, in full width."""
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: True)
    freeze(net)
    result = net(torch.randn(50, 5))
    result.sum().backward()
    assert result.dtype == torch.float32
    assert all(parameter.grad is not None for parameter in net.parameters())


@pytest.mark.parametrize("missing", ["processor", "operator"])
def test_without_bfloat16_or_the_operator_torch_serves(net, monkeypatch, missing):
    """Everything then goes as it always went."""
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: missing != "processor")
    monkeypatch.setattr(linear, "_product", None if missing == "operator" else torch.nn.Identity())
    freeze(net)
    with torch.inference_mode():
        result = net(torch.randn(50, 5))
    assert result.dtype == torch.float32
