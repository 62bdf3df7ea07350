# SPDX-License-Identifier: Apache-2.0
import copy

import pytest
import torch

from pugeo_model.network import linear
from pugeo_model.network.linear import Linear, Rectified, freeze


@pytest.fixture
def net():
    """Layers with and without a bias, of widths that are no multiples of the vector size."""
    torch.manual_seed(0)
    return torch.nn.Sequential(Rectified(5, 33), Rectified(33, 16), Linear(16, 7, bias=False))


def test_the_fused_layer_equals_torch(net, monkeypatch):
    """The fused operator equals torch's layers in bfloat16, for inputs of any shape."""
    if not linear._fused_product_works():
        pytest.skip("oneDNN has no bfloat16 product for this processor")
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: True)
    rows = torch.randn(12, 50, 5)
    plain = copy.deepcopy(net)
    freeze(net)
    with torch.inference_mode():
        fused = net(rows)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(fused, plain(rows))
    assert fused.dtype == torch.bfloat16
    assert fused.shape == (12, 50, 7)


def test_a_frozen_layer_can_be_trained(net, monkeypatch):
    """With gradients the float32 weights are used."""
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: True)
    freeze(net)
    result = net(torch.randn(50, 5))
    result.sum().backward()
    assert result.dtype == torch.float32
    assert all(parameter.grad is not None for parameter in net.parameters())


@pytest.mark.parametrize("missing", ["processor", "operator"])
def test_without_bfloat16_or_the_operator(net, monkeypatch, missing):
    """Torch's float32 layers are used."""
    monkeypatch.setattr(linear, "bfloat16_pays", lambda: missing != "processor")
    monkeypatch.setattr(linear, "_product", None if missing == "operator" else torch.nn.Identity())
    freeze(net)
    with torch.inference_mode():
        result = net(torch.randn(50, 5))
    assert result.dtype == torch.float32
