# SPDX-License-Identifier: Apache-2.0
"""The switches of Table 3 in the served network."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import extract_patch
from pugeo_model.network.neighbourhoods import stack_patches
from pugeo_model.network.pattern import disk
from pugeo_model.network.pugeo import Architecture, PUGeoNet


def _patch(points):
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    return extract_patch(np.arange(200, dtype=np.int32), points, neighbours, frames)


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
    patch = _patch(sphere)
    quadric = torch.from_numpy(patch.frames.quadric[:200])
    with torch.inference_mode():
        charts, uv = net(stack_patches([patch]), quadric, 4)
    assert uv.shape == (200, 4, 2)
    if switch == "adaptive_uv":
        torch.testing.assert_close(uv, 0.87 * torch.from_numpy(disk(4)).expand(200, 4, 2))
    if switch == "linear_map":
        torch.testing.assert_close(charts.T, torch.eye(3).expand(200, 3, 3))
