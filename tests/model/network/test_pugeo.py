# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import extract_patch
from pugeo_model.network.neighbourhoods import stack_patches
from pugeo_model.network.projection import blend
from pugeo_model.network.pugeo import Charts, PUGeoNet, evaluate


@pytest.fixture
def net():
    """An untrained network, which reproduces the quadric fit."""
    torch.manual_seed(0)
    return PUGeoNet().eval()


def patch_of(points, core=None):
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    core = np.arange(200, dtype=np.int32) if core is None else core
    return extract_patch(core, points, neighbours, frames)


@pytest.mark.parametrize("count", [1, 4, 7, 32])
def test_shapes_for_any_ratio(net, sphere, count):
    """One network gives any number of samples per chart."""
    patch = patch_of(sphere)
    quadric = torch.from_numpy(patch.frames.quadric[:200])
    with torch.inference_mode():
        charts, uv = net(stack_patches([patch]), quadric, count)
        points, normals, log_error = evaluate(net.surface, charts, uv)
    assert uv.shape == (200, count, 2)
    assert points.shape == normals.shape == (200, count, 3)
    assert log_error.shape == (200, count)
    assert points.dtype == normals.dtype == torch.float32


def test_t_is_a_rotation_and_gives_the_coarse_normal(net, sphere):
    """T is orthonormal; its third column, T (0, 0, 1), is the cross product of the tangents."""
    patch = patch_of(sphere)
    with torch.inference_mode():
        charts, _ = net(stack_patches([patch]), torch.from_numpy(patch.frames.quadric[:200]), 4)
    identity = charts.T.mT @ charts.T
    torch.testing.assert_close(identity, torch.eye(3).expand_as(identity), atol=1e-5, rtol=0)
    first, second, third = charts.T.unbind(-1)
    torch.testing.assert_close(torch.linalg.cross(first, second), third)


def test_untrained_network_is_the_jet_baseline(net, sphere):
    """Before training, samples of a sphere are as accurate as a quadric fit."""
    patch = patch_of(sphere)
    frames = patch.frames
    with torch.inference_mode():
        charts, uv = net(stack_patches([patch]), torch.from_numpy(frames.quadric[:200]), 8)
        local, normals, _ = evaluate(net.surface, charts, uv)
    world = patch.points[:200, None] + (
        (local.numpy() @ frames.axes[:200]) * frames.spacing[:200, None, None]
    )
    assert np.abs(np.linalg.norm(world, axis=-1) - 1).mean() < 0.02 * frames.spacing.mean()
    unit = world / np.linalg.norm(world, axis=-1, keepdims=True)
    cosine = np.abs((normals.numpy() @ frames.axes[:200] * unit).sum(-1))
    assert np.degrees(np.arccos(cosine.clip(0, 1))).mean() < 2.0


def test_patches_together_or_alone_are_the_same_graph(net, sphere):
    """Two patches in one graph have the same features as each alone."""
    left = patch_of(sphere, np.arange(100, dtype=np.int32))
    right = patch_of(sphere, np.arange(500, 620, dtype=np.int32))
    with torch.inference_mode():
        both = net.backbone(stack_patches([left, right]))[:220]
        one, other = net.backbone(stack_patches([left])), net.backbone(stack_patches([right]))
    assert len(one) == len(other) == 128  # with padding
    alone = torch.cat([one[:100], other[:120]])
    torch.testing.assert_close(both, alone, atol=1e-4, rtol=1e-4)


def test_blend_leaves_points_of_a_plane_alone(net, plane):
    """On a plane all charts are equal, and a point of the plane does not move."""
    points, normal = plane
    patch = patch_of(points, np.arange(len(points), dtype=np.int32))
    frames = patch.frames
    with torch.inference_mode():
        charts, _ = net(stack_patches([patch]), torch.from_numpy(frames.quadric), 4)
        rows = torch.tensor([[700, 701, 702], [800, 801, 760]])
        picked = Charts(*(field[rows.flatten()] for field in vars(charts).values()))
        queries = torch.from_numpy(points[rows.numpy()].mean(axis=1, keepdims=True))
        offsets = (queries - torch.from_numpy(points[rows.numpy()])).float()
        step, normals, _, _ = blend(
            net.surface,
            picked,
            offsets,
            torch.from_numpy(frames.axes)[rows],
            torch.from_numpy(frames.spacing)[rows],
        )
    assert step.norm(dim=1).max() < 0.05 * frames.spacing.mean()
    cosine = (normals.numpy() @ normal).astype(np.float64)
    assert np.abs(cosine).min() > 0.99
