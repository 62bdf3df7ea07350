# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
from torch.nn import functional

from pugeo_model.network.backbones.edge_conv import EdgeConv, PointMLP, knn_graph


def by_edges(conv, features, graph):
    """The published form: one product for each edge, on [x_i, x_j - x_i]."""
    own = features.unsqueeze(0).expand(len(graph), -1, -1)
    edge = torch.cat([own, features[graph] - own], dim=-1)
    values = functional.linear(edge, conv.first.weight, conv.first.bias)
    if conv.norm is not None:
        values = conv.norm(values.flatten(0, 1)).unflatten(0, tuple(graph.shape))
    values = functional.relu(values)
    return conv.deeper(values.flatten(0, 1)).unflatten(0, tuple(graph.shape))


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("norm", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_products_per_point_equal_products_per_edge(layers, norm, training):
    """``W [x_i, x_j - x_i] = (W1 - W2) x_i + W2 x_j``, to 1e-5, values and gradients."""
    torch.manual_seed(0)
    conv = EdgeConv(16, 64, layers, norm=norm).train(training)
    features = torch.randn(512, 16)
    graph = knn_graph(features.unflatten(0, (2, 256)), 30)
    fast, plain = features.clone().requires_grad_(), features.clone().requires_grad_()
    ours, published = conv.edges(fast, graph), by_edges(conv, plain, graph)
    torch.testing.assert_close(ours, published, atol=1e-5, rtol=1e-5)
    ours.square().mean().backward()
    published.square().mean().backward()
    torch.testing.assert_close(fast.grad, plain.grad, atol=1e-5, rtol=1e-5)


def test_pooling_is_the_maximum_and_the_mean():
    """Both over the neighbours, side by side."""
    torch.manual_seed(1)
    conv = EdgeConv(3, 8, norm=False).eval()
    features = torch.randn(40, 3)
    graph = knn_graph(features.unsqueeze(0), 5)
    pooled, edges = conv(features, graph), conv.edges(features, graph)
    torch.testing.assert_close(pooled, torch.cat([edges.amax(0), edges.mean(0)], dim=-1))


def test_an_edge_by_hand():
    """One channel, W = (2, 3), b = -1, points 1 and 4: ReLU(2 x_i + 3 (x_j - x_i) - 1)."""
    conv = EdgeConv(1, 1, norm=False)
    with torch.no_grad():
        conv.first.weight.copy_(torch.tensor([[2.0, 3.0]]))
        conv.first.bias.fill_(-1.0)
    edges = conv.edges(torch.tensor([[1.0], [4.0]]), torch.tensor([[0, 1], [1, 0]]))
    assert edges.squeeze(-1).tolist() == [[1.0, 7.0], [10.0, 0.0]]


def test_graphs_stay_within_their_patch():
    """Neighbours are those of a plain search, the point itself included, patch by patch."""
    rng = np.random.default_rng(0)
    points = rng.random((3, 50, 3)).astype(np.float32)
    graph = knn_graph(torch.from_numpy(points), 7).numpy()
    for patch in range(3):
        apart = np.linalg.norm(points[patch, :, None] - points[patch, None], axis=-1)
        wanted = np.sort(np.argsort(apart, axis=1)[:, :7], axis=1)
        found = np.sort(graph[:, 50 * patch : 50 * (patch + 1)].T - 50 * patch, axis=1)
        np.testing.assert_array_equal(found, wanted)


def test_a_layer_of_a_shared_mlp():
    """Linear, batch norm, ReLU: channels of a training batch have their mean at zero before it."""
    torch.manual_seed(0)
    layer = PointMLP(4, 6, norm=True)
    before = layer[1](layer[0](torch.randn(100, 4)))
    torch.testing.assert_close(before.mean(0), torch.zeros(6), atol=1e-5, rtol=0)
    assert layer(torch.randn(100, 4)).min() == 0.0
