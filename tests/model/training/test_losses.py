# SPDX-License-Identifier: Apache-2.0
"""The joint loss."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pugeo_model.network.pugeo import PUGeoNet
from pugeo_model.training.augment import Mix
from pugeo_model.training.batches import Batches
from pugeo_model.training.losses import JointLoss, LossWeights, _pseudo_huber, _unoriented


def loss_of(shapes, net, samples, weights=None):
    """Loss and terms of a batch with fixed random numbers."""
    return JointLoss(shapes, weights)(net, 4, samples, np.random.default_rng(0))


@pytest.fixture(scope="module")
def net(small):
    """An untrained small network."""
    torch.manual_seed(0)
    return PUGeoNet(small)


@pytest.fixture(scope="module")
def samples(shapes):
    """Clean patches."""
    clean = Mix(noisy=0, random=0, ramp=0, cut=0, lines=0)
    return Batches(shapes, clean, 0, 10)[2][1]


def test_all_terms_are_finite_and_have_gradients(shapes, net, samples):
    """Each parameter of the network has a non-zero gradient."""
    total, parts = loss_of(shapes, net, samples)
    total.backward()
    assert all(np.isfinite(value) for value in parts.values())
    without = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert without == []


def test_an_untrained_network_is_accurate(shapes, net, samples):
    """The network starts from the quadric fit: P2F is a small fraction of a spacing."""
    with torch.no_grad():
        _, parts = loss_of(shapes, net, samples)
    assert parts["p2f"] < 0.05
    assert parts["refined_normal"] < 0.2


def test_weights_scale_their_terms(shapes, net, samples):
    """The weight of a term changes the total by the term times the difference."""
    with torch.no_grad():
        base, parts = loss_of(shapes, net, samples)
        more, _ = loss_of(shapes, net, samples, replace(LossWeights(), coverage=2.0))
    assert float(more - base) == pytest.approx(parts["coverage"], rel=1e-4)


def test_noise_lowers_the_weight_of_a_patch(shapes, net, samples):
    """A patch that counts as very noisy hardly changes the loss of the other patches."""
    first, second, *_ = samples
    with torch.no_grad():
        alone = loss_of(shapes, net, [first])[1]["p2f"]
        equal = loss_of(shapes, net, [first, second])[1]["p2f"]
        noisy = loss_of(shapes, net, [first, replace(second, noise=1e6)])[1]["p2f"]
    assert noisy == pytest.approx(alone, rel=1e-3)
    assert abs(equal - alone) > 10 * abs(noisy - alone)


def test_normals_of_either_sign():
    """The unoriented difference of a normal and its opposite is zero, of a right angle 1.41."""
    up = torch.tensor([[0.0, 0.0, 1.0]])
    for sign in (1.0, -1.0):
        assert float(_unoriented(up, sign * up)) == pytest.approx(0.0, abs=2e-3)
    assert float(_unoriented(up, torch.tensor([[1.0, 0.0, 0.0]]))) == pytest.approx(
        2**0.5, abs=1e-3
    )


def test_outliers_have_a_bounded_gradient():
    """The pseudo-Huber loss is the square for small distances and linear for large ones."""
    distance = torch.tensor([0.001, 10.0, 20.0], requires_grad=True)
    values = _pseudo_huber(distance)
    assert float(values[0].detach()) == pytest.approx(1e-6, rel=0.01)
    values.sum().backward()
    assert distance.grad is not None
    assert float(distance.grad[2]) == pytest.approx(float(distance.grad[1]), rel=1e-3)
