# SPDX-License-Identifier: Apache-2.0
from typing import Any

import pytest
import torch
from torch.nn import functional

from pugeo_model.network.backbones.dgcnn import DGCNN, InputTransform


@pytest.fixture
def patches():
    """Two patches of 64 points, float32 ``(2, 64, 3)``."""
    torch.manual_seed(0)
    return torch.randn(2, 64, 3)


def small(**options: Any):
    torch.manual_seed(1)
    return DGCNN(32, k=8, width=16, fused=24, **options).eval()


def test_shapes(patches):
    """Features come out for every point; three levels have three parts each, and two are fused."""
    net = small()
    assert net(patches).shape == (2, 64, 32)
    assert net.sizes == [16] * 9 + [24, 24]
    assert small(levels=2).sizes == [16] * 6 + [24, 24]


def test_the_recalibration_weights_are_a_softmax():
    """``w = softmax(h_r(c))`` (eq. 2) for all levels, the last one too, times their number."""
    net = small()
    each, patch = torch.randn(128, 9 * 16 + 24), torch.randn(2, 24)
    weights = net.weights(each, patch)
    whole = torch.cat([each, patch.repeat_interleave(64, dim=0)], dim=-1)
    first, second, last = net.logits
    logits = last(second(functional.relu(first(whole))))
    torch.testing.assert_close(weights, 11 * functional.softmax(logits, dim=-1))
    torch.testing.assert_close(weights.sum(-1), torch.full((128,), 11.0))


def test_the_global_feature_enters_once(patches, monkeypatch):
    """Products made once a patch equal those on the tiled concatenation (eq. 3), to 1e-5."""
    net = small(norm=False)
    seen = {}
    weigh = net.weights

    def watch(each, patch):
        seen["each"], seen["patch"], seen["weights"] = each, patch, weigh(each, patch)
        return seen["weights"]

    monkeypatch.setattr(net, "weights", watch)
    found = net(patches)
    tiled = torch.cat([seen["each"], seen["patch"].repeat_interleave(64, dim=0)], dim=-1)
    parts = tiled.split(net.sizes, dim=-1)
    weighted = [part * seen["weights"][:, i : i + 1] for i, part in enumerate(parts)]
    plain = functional.relu(net.out(torch.cat(weighted, dim=-1))).unflatten(0, (2, 64))
    torch.testing.assert_close(found, plain, atol=1e-5, rtol=1e-5)


def test_without_recalibration_levels_are_concatenated(patches):
    """The ablation has no weights, and its features no layer for them."""
    net = small(recalibrate=False)
    assert net.weights(torch.zeros(1), torch.zeros(1)) is None
    assert net(patches).shape == (2, 64, 32)
    assert not [name for name, _ in net.named_parameters() if "logits" in name]


def test_the_input_transform_starts_as_the_identity(patches):
    """An untrained STN leaves points where they are; trained, it is one matrix a patch."""
    stn = InputTransform(8, norm=True).eval()
    torch.testing.assert_close(stn(patches), torch.eye(3).expand(2, 3, 3))
    torch.nn.init.normal_(stn.out.weight)
    assert stn(patches).shape == (2, 3, 3)
    assert not torch.allclose(stn(patches)[0], stn(patches)[1])


def test_points_in_another_order_get_the_same_features(patches):
    """The network sees a set: rows of the features follow the points."""
    net, order = small(), torch.randperm(64)
    torch.testing.assert_close(net(patches[:, order]), net(patches)[:, order], atol=1e-5, rtol=1e-4)


def test_patches_do_not_see_each_other_when_served(patches):
    """In evaluation a patch has the same features alone and in a batch."""
    net = small()
    torch.testing.assert_close(net(patches[:1]), net(patches)[:1], atol=1e-6, rtol=1e-5)
