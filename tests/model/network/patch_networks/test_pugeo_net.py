# SPDX-License-Identifier: Apache-2.0
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from pugeo_model.network.patch_networks.pugeo_net import (
    PUGeoNetPaper,
    SampleMLP,
    principal_axes,
)
from pugeo_model.network.pattern import regular_grid

SMALL: dict[str, Any] = {"features": 16, "head": 8, "k": 6, "width": 8, "fused": 16}


@pytest.fixture
def patches():
    """Two flat patches of 64 points and radius about 1, float32 ``(2, 64, 3)``."""
    torch.manual_seed(0)
    return torch.randn(2, 64, 3) * torch.tensor([0.4, 0.3, 0.05])


class Constant(SampleMLP):
    """An f3 or f4 that always answers the same and keeps what it was asked."""

    def __init__(self, answer) -> None:
        nn.Module.__init__(self)
        self.answer, self.asked = torch.tensor(answer), torch.empty(0)

    def forward(self, samples, _features):
        self.asked = samples
        return self.answer.expand(*samples.shape[:2], -1)


def test_equations_by_hand(patches):
    """Points and normals follow eq. 4 to 11 from given (u, v), T, delta and normal offset."""
    net = PUGeoNetPaper(2, align=False, **SMALL).eval()
    T = torch.tensor([[1.0, 0.5, 0.0], [0.0, 2.0, 0.6], [0.0, 0.0, 0.8]])
    uv = torch.tensor([[1.0, -1.0], [0.5, 2.0]])
    with torch.no_grad():
        for layer, values in ((net.uv, uv), (net.T, T)):
            assert layer is not None
            layer.weight.zero_()
            layer.bias.copy_(values.flatten())
    displacement = Constant([0.25])
    net.displacement, net.normal_offset = displacement, Constant([0.3, 0.0, 0.0])
    output = net(patches)
    spacing = (3.0 / 64) ** 0.5
    for r, (u, v) in enumerate(uv.tolist()):
        tangent = patches + spacing * (T @ torch.tensor([u, v, 0.0]))
        torch.testing.assert_close(displacement.asked[:, r], tangent.flatten(0, 1))
        wanted = tangent + spacing * 0.25 * T[:, 2]
        torch.testing.assert_close(output.points[:, :, r], wanted)
    coarse = torch.tensor([0.0, 0.6, 0.8])
    torch.testing.assert_close(output.coarse_normals, coarse.expand(2, 64, 3))
    refined = torch.tensor([0.3, 0.6, 0.8]) / (0.09 + 1.0) ** 0.5
    torch.testing.assert_close(output.normals, refined.expand(2, 64, 2, 3))
    assert output.geometry is not None
    torch.testing.assert_close(output.geometry.displacement, torch.full((2, 64, 2), 0.25 * spacing))
    torch.testing.assert_close(output.geometry.T, T.expand(2, 64, 3, 3))


def test_the_sample_mlp_is_one_on_the_concatenation():
    """Features enter once a point; the result is that of the layer on Concat(x_hat, c), to 1e-5."""
    torch.manual_seed(0)
    mlp = SampleMLP(16, 8, 3, norm=False)
    samples, features = torch.randn(10, 4, 3), torch.randn(10, 16)
    joined = torch.cat([samples, features.unsqueeze(1).expand(-1, 4, -1)], dim=-1)
    weight = torch.cat([mlp.position.weight, mlp.code.weight], dim=1)
    first = torch.relu(nn.functional.linear(joined, weight, mlp.code.bias))
    plain = mlp.out(mlp.hidden(first.flatten(0, 1))).unflatten(0, (10, 4))
    torch.testing.assert_close(mlp(samples, features), plain, atol=1e-5, rtol=1e-5)


def test_it_starts_at_an_even_disk_on_the_principal_plane(patches):
    """Quiet heads: samples spread around their points, normals along the least variance."""
    torch.manual_seed(0)
    with torch.inference_mode():
        output = PUGeoNetPaper(4, **SMALL).eval()(patches)
    offset = output.points - patches.unsqueeze(2)
    spacing = (3.0 / 64) ** 0.5
    assert 0.2 < float(offset.norm(dim=-1).mean()) / spacing < 0.6
    normal = principal_axes(patches)[:, 2]
    cosine = (output.coarse_normals * normal.unsqueeze(1)).sum(-1)
    assert float(cosine.min()) > 0.99
    assert float((output.normals * normal[:, None, None]).sum(-1).min()) > 0.9


def test_principal_axes_are_rotations(patches):
    """Rows are orthonormal, right-handed, and sorted by falling variance."""
    axes = principal_axes(patches)
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand(2, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(2))
    spread = (patches @ axes.mT).square().sum(1)
    assert (spread[:, :-1] >= spread[:, 1:]).all()


def test_alignment_turns_there_and_back(patches):
    """The aligned network is the plain one on turned patches, its output turned back."""
    torch.manual_seed(0)
    net = PUGeoNetPaper(2, quiet=False, **SMALL).eval()
    axes = principal_axes(patches)
    found, plain = net(patches), net._upsample(patches @ axes.mT)
    assert found.geometry is not None
    assert plain.geometry is not None
    for b in range(2):
        for ours, theirs in ((found.points, plain.points), (found.normals, plain.normals)):
            assert ours is not None
            assert theirs is not None
            torch.testing.assert_close(ours[b], theirs[b] @ axes[b])
        T = found.geometry.T[b]
        torch.testing.assert_close(T, axes[b].T @ plain.geometry.T[b])
        torch.testing.assert_close(
            found.coarse_normals[b], nn.functional.normalize(T[..., 2], dim=-1)
        )


@pytest.mark.parametrize(
    ("switch", "has_normals", "has_coarse", "has_geometry"),
    [
        ({}, True, True, True),
        ({"recalibrate": False}, True, True, True),
        ({"normals": False}, False, False, True),
        ({"adaptive_uv": False}, True, True, True),
        ({"linear_map": False}, True, False, False),
        ({"coarse_to_fine": False}, True, False, True),
    ],
)
@pytest.mark.parametrize("quiet", [True, False])
def test_ablations(patches, switch, has_normals, has_coarse, has_geometry, quiet):
    """Each switch of Table 3 leaves out its part; everything left is trained."""
    torch.manual_seed(0)
    net = PUGeoNetPaper(8, quiet=quiet, **SMALL, **switch)
    output = net(patches)
    assert output.points.shape == (2, 64, 8, 3)
    assert (output.normals is not None) == has_normals
    assert (output.coarse_normals is not None) == has_coarse
    assert (output.geometry is not None) == has_geometry
    total = output.points.square().sum()
    for normals in (output.normals, output.coarse_normals):
        if normals is not None:
            torch.testing.assert_close(normals.norm(dim=-1), torch.ones(normals.shape[:-1]))
            total = total + normals[..., 0].square().sum()
    total.backward()
    # What stands before a batch norm of its own has no say: a bias that it takes out again.
    silent = [n for n, p in net.named_parameters() if p.grad is None]
    assert silent == []


def test_the_fixed_grid_is_regular_and_not_learned(patches):
    """8 samples lie on 2 x 4 cells of area 1/8, the same for every point."""
    net = PUGeoNetPaper(8, adaptive_uv=False, align=False, **SMALL).eval()
    uv = net(patches).geometry.uv
    grid = torch.from_numpy(regular_grid(8))
    torch.testing.assert_close(uv, ((3.0 / 64) ** 0.5 * grid).expand(2, 64, 8, 2))
    steps = np.diff(np.unique(np.round(regular_grid(8)[:, 0], 6)))
    np.testing.assert_allclose(steps, 8**-0.5, atol=1e-5)


def test_parts_that_need_each_other():
    """Without T there is no coarse prediction that could be left out as well."""
    with pytest.raises(ValueError, match="cannot both"):
        PUGeoNetPaper(4, linear_map=False, coarse_to_fine=False)


@pytest.mark.parametrize(("ratio", "megabytes"), [(4, 26.1), (16, 26.2)])
def test_size_beside_the_paper(ratio, megabytes):
    """With two moments for each weight: 26.1 MB; the paper prints 26.6 MB, and 26.7 at R=16."""
    count = sum(p.numel() for p in PUGeoNetPaper(ratio).parameters())
    assert 3 * 4 * count / 1e6 == pytest.approx(megabytes, abs=0.06)
