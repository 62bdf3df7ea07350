# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import cut
from pugeo_model.network.blend import blend
from pugeo_model.network.neighbourhoods import gather
from pugeo_model.network.pattern import disk
from pugeo_model.network.pugeo import Architecture, Charts, PUGeoNet, evaluate


@pytest.fixture
def net():
    """An untrained network: output layers near zero, so it answers the quadric fit."""
    torch.manual_seed(0)
    return PUGeoNet().eval()


def patch_of(points, core=None):
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    core = np.arange(200, dtype=np.int32) if core is None else core
    return cut(core, points, neighbours, frames)


@pytest.mark.parametrize("count", [1, 4, 7, 32])
def test_shapes_for_any_ratio(net, sphere, count):
    """One network gives any number of samples a chart."""
    patch = patch_of(sphere)
    quadric = torch.from_numpy(patch.frames.quadric[:200])
    with torch.inference_mode():
        charts, uv = net(gather([patch]), quadric, count)
        points, normals, log_error = evaluate(net.surface, charts, uv)
    assert uv.shape == (200, count, 2)
    assert points.shape == normals.shape == (200, count, 3)
    assert log_error.shape == (200, count)
    assert points.dtype == normals.dtype == torch.float32


def test_t_is_a_rotation_and_gives_the_coarse_normal(net, sphere):
    """T is orthonormal; its third column, T (0, 0, 1), is the cross product of the tangents."""
    patch = patch_of(sphere)
    with torch.inference_mode():
        charts, _ = net(gather([patch]), torch.from_numpy(patch.frames.quadric[:200]), 4)
    identity = charts.T.mT @ charts.T
    torch.testing.assert_close(identity, torch.eye(3).expand_as(identity), atol=1e-5, rtol=0)
    first, second, third = charts.T.unbind(-1)
    torch.testing.assert_close(torch.linalg.cross(first, second), third)


def test_untrained_network_is_the_jet_baseline(net, sphere):
    """Before training, samples of a sphere lie on it about as well as a quadric does."""
    patch = patch_of(sphere)
    frames = patch.frames
    with torch.inference_mode():
        charts, uv = net(gather([patch]), torch.from_numpy(frames.quadric[:200]), 8)
        local, normals, _ = evaluate(net.surface, charts, uv)
    world = patch.points[:200, None] + (
        (local.numpy() @ frames.axes[:200]) * frames.spacing[:200, None, None]
    )
    assert np.abs(np.linalg.norm(world, axis=-1) - 1).mean() < 0.02 * frames.spacing.mean()
    unit = world / np.linalg.norm(world, axis=-1, keepdims=True)
    cosine = np.abs((normals.numpy() @ frames.axes[:200] * unit).sum(-1))
    assert np.degrees(np.arccos(cosine.clip(0, 1))).mean() < 2.0


def test_patches_together_or_alone_are_the_same_graph(net, sphere):
    """Two patches put into one graph see the same neighbours as each alone."""
    left = patch_of(sphere, np.arange(100, dtype=np.int32))
    right = patch_of(sphere, np.arange(500, 620, dtype=np.int32))
    with torch.inference_mode():
        both = net.backbone(gather([left, right]))[:220]
        one, other = net.backbone(gather([left])), net.backbone(gather([right]))
    assert len(one) == len(other) == 128  # filled up
    alone = torch.cat([one[:100], other[:120]])
    torch.testing.assert_close(both, alone, atol=1e-4, rtol=1e-4)


def test_blend_leaves_points_of_a_plane_alone(net, plane):
    """On a plane all charts agree, and a spot in the plane has nowhere to go."""
    points, normal = plane
    patch = patch_of(points, np.arange(len(points), dtype=np.int32))
    frames = patch.frames
    with torch.inference_mode():
        charts, _ = net(gather([patch]), torch.from_numpy(frames.quadric), 4)
        rows = torch.tensor([[700, 701, 702], [800, 801, 760]])
        picked = Charts(*(field[rows.flatten()] for field in vars(charts).values()))
        spots = torch.from_numpy(points[rows.numpy()].mean(axis=1, keepdims=True))
        offsets = (spots - torch.from_numpy(points[rows.numpy()])).float()
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


@pytest.mark.parametrize("switch", ["adaptive_uv", "linear_map", "recalibrate"])
def test_ablations(sphere, switch):
    """Each switch of Table 3 leaves out its part and its weights; the card rebuilds the network."""
    torch.manual_seed(0)
    full = Architecture(options=(("width", 16), ("edge_width", 16)), features=32, head=32)
    if switch == "recalibrate":
        options = (*full.options, ("recalibrate", False))
        architecture = replace(full, options=options)
    else:
        changed: dict[str, Any] = {switch: False}
        architecture = replace(full, **changed)
    assert Architecture.from_json(architecture.to_json()) == architecture
    assert switch not in full.to_json()
    net = PUGeoNet(architecture).eval()
    whole = {name for name, _ in PUGeoNet(full).named_parameters()}
    gone = whole - {name for name, _ in net.named_parameters()}
    part = {"adaptive_uv": "samples.", "linear_map": "frame.", "recalibrate": ".logits."}[switch]
    assert gone
    assert all(part in name for name in gone)
    patch = patch_of(sphere)
    quadric = torch.from_numpy(patch.frames.quadric[:200])
    with torch.inference_mode():
        charts, uv = net(gather([patch]), quadric, 4)
    assert uv.shape == (200, 4, 2)
    if switch == "adaptive_uv":
        torch.testing.assert_close(uv, 0.87 * torch.from_numpy(disk(4)).expand(200, 4, 2))
    if switch == "linear_map":
        torch.testing.assert_close(charts.T, torch.eye(3).expand(200, 3, 3))
