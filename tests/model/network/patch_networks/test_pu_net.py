# SPDX-License-Identifier: Apache-2.0
from typing import Any

import numpy as np
import pytest
import torch

from pugeo_model.network.backbones.pointnet2 import PointNet2, SetAbstraction, interpolate
from pugeo_model.network.patch_networks.pu_net import PUNet


@pytest.fixture
def patches():
    """Two patches of 64 points, float32 ``(2, 64, 3)``."""
    torch.manual_seed(0)
    return 0.5 * torch.randn(2, 64, 3)


def test_a_ball_keeps_its_radius():
    """Points beyond the radius have no say in a centre's feature."""
    torch.manual_seed(0)
    level = SetAbstraction(0, (8,), 0.5, norm=False).eval()
    points = torch.tensor([[[0.0, 0, 0], [0.3, 0, 0], [2.0, 0, 0]]])
    near = level(points, points[..., :0], points[:, :1])
    moved = points.clone()
    moved[0, 2] = torch.tensor([0.0, 3.0, 0.0])
    torch.testing.assert_close(level(moved, points[..., :0], points[:, :1]), near)
    moved[0, 1] = torch.tensor([0.0, 0.4, 0.0])
    assert not torch.allclose(level(moved, points[..., :0], points[:, :1]), near)


def test_interpolation_by_hand():
    """Weights are inverse squared distances, normalised: 1/1, 1/4 and 1/16 at 1, 2 and 4."""
    centres = torch.tensor([[[1.0, 0, 0], [-2.0, 0, 0], [0, 4.0, 0]]])
    values = torch.tensor([[[21.0], [0.0], [42.0]]])
    found = interpolate(torch.zeros(1, 1, 3), centres, values)
    assert float(found) == pytest.approx((21 + 42 / 16) / (1 + 1 / 4 + 1 / 16), rel=1e-5)


def test_features_of_all_points(patches):
    """Coordinates, 64 fine channels and 64 from each of the three coarser levels."""
    net = PointNet2(norm=True).eval()
    found = net(patches)
    assert found.shape == (2, 64, 3 + 64 + 3 * 64)
    torch.testing.assert_close(found[..., :3], patches)


@pytest.mark.parametrize("normals", [False, True])
def test_shapes(patches, normals):
    """R branches give R samples; PU-Net-M gives unit normals as well."""
    output = PUNet(3, normals=normals).eval()(patches)
    assert output.points.shape == (2, 64, 3, 3)
    assert output.coarse_normals is None
    if normals:
        lengths = output.normals.norm(dim=-1).detach().numpy()
        np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
    else:
        assert output.normals is None


def test_branches_are_independent(patches):
    """Each branch has weights of its own: a change of one moves its samples alone."""
    torch.manual_seed(0)
    net: Any = PUNet(2).eval()
    before = net(patches).points
    with torch.no_grad():
        net.branches[1][1][0].weight.mul_(2.0)
    after = net(patches).points
    torch.testing.assert_close(after[:, :, 0], before[:, :, 0])
    assert not torch.allclose(after[:, :, 1], before[:, :, 1])


def test_residual_coordinates(patches):
    """With a silent last layer samples lie on their points, or at the centre if not residual."""
    for residual in (True, False):
        net = PUNet(2, residual=residual).eval()
        torch.nn.init.zeros_(net.out.weight)
        torch.nn.init.zeros_(net.out.bias)
        wanted = patches.unsqueeze(2).expand(-1, -1, 2, -1) * float(residual)
        torch.testing.assert_close(net(patches).points, wanted)


@pytest.mark.parametrize(("ratio", "megabytes"), [(4, 9.8), (8, 14.6), (12, 19.4), (16, 24.2)])
def test_size_beside_the_paper(ratio, megabytes):
    """With two moments for each weight; printed: 10.1, 14.9, 19.7 and 24.5 MB."""
    count = sum(p.numel() for p in PUNet(ratio).parameters())
    assert 3 * 4 * count / 1e6 == pytest.approx(megabytes, abs=0.06)
