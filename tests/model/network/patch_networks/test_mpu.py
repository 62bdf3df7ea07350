# SPDX-License-Identifier: Apache-2.0
from typing import Any

import pytest
import torch

from pugeo_model.network.backbones.dense_edge_conv import DenseEdgeConv, DenseFeatures
from pugeo_model.network.backbones.edge_conv import knn_graph
from pugeo_model.network.patch_networks.mpu import MPU


@pytest.fixture
def patches():
    """Two patches of 64 points, float32 ``(2, 64, 3)``."""
    torch.manual_seed(0)
    return 0.5 * torch.randn(2, 64, 3)


def test_a_dense_block_equals_its_published_form():
    """Layers on [x_i, x_j - x_i], then on all layers before and x_i; maximum; x_i appended."""
    torch.manual_seed(0)
    block: Any = DenseEdgeConv(5, growth=4)
    features = torch.randn(50, 5)
    graph = knn_graph(features.unsqueeze(0), 6)
    own = features.expand(6, -1, -1)
    edge = torch.cat([own, features[graph] - own], dim=-1)
    first = torch.relu(block.first.first(edge))
    weight = torch.cat([block.deeper[0].weight, block.own[0].weight], dim=1)
    joined = torch.cat([first, own], dim=-1)
    second = torch.relu(torch.nn.functional.linear(joined, weight, block.own[0].bias))
    weight = torch.cat([block.deeper[1].weight, block.own[1].weight], dim=1)
    joined = torch.cat([second, first, own], dim=-1)
    third = torch.nn.functional.linear(joined, weight, block.own[1].bias)
    pooled = torch.cat([third, second, first], dim=-1).amax(0)
    wanted = torch.cat([pooled, features], dim=-1)
    torch.testing.assert_close(block(features, graph), wanted, atol=1e-5, rtol=1e-5)
    assert block.outputs == wanted.shape[1]


def test_features_of_all_points(patches):
    """The outputs of all blocks, for every point."""
    net = DenseFeatures(k=6, growth=8, blocks=3)
    assert net(patches).shape == (2, 64, net.features)


@pytest.mark.parametrize("ratio", [2, 4, 8])
def test_shapes_and_owners(patches, ratio):
    """R samples for every point, those of a point together."""
    torch.manual_seed(0)
    net: Any = MPU(ratio, features=16, head=16, growth=8)
    output = net(patches)
    assert output.points.shape == (2, 64, ratio, 3)
    assert output.normals is None
    assert len(net.units) == ratio.bit_length() - 1
    with torch.no_grad():
        for unit in net.units:
            unit.out.weight.zero_()
    still = patches.unsqueeze(2).expand(-1, -1, ratio, -1)
    torch.testing.assert_close(net(patches).points, still)


def test_every_level_is_trained(patches):
    """A loss on the last level alone reaches all weights."""
    torch.manual_seed(0)
    net = MPU(4, features=16, head=16, growth=8)
    net(patches).points.square().sum().backward()
    silent = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert silent == []


@pytest.mark.parametrize("ratio", [1, 3, 12])
def test_only_powers_of_two(ratio):
    """As in the paper's table, which has no MPU at R=12."""
    with pytest.raises(ValueError, match="powers of 2"):
        MPU(ratio)


def test_one_width():
    """Features and regression share their width."""
    with pytest.raises(ValueError, match="one width"):
        MPU(4, features=64, head=128)
