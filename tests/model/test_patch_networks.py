# SPDX-License-Identifier: Apache-2.0
"""The way of a cloud through networks that upsample whole patches."""

import numpy as np
import pytest
import torch

from pugeo_model.cloud import Cloud
from pugeo_model.errors import BadOptionError
from pugeo_model.network.build import build_network
from pugeo_model.network.pugeo import Architecture
from pugeo_model.options import Options
from pugeo_model.plan import make_plan
from pugeo_model.upsampler import Upsampler
from pugeo_model.weights import save

SMALL = {"k": 8, "width": 8, "fused": 16}
ARCHITECTURES = {
    "pugeo-net": Architecture("pugeo-net", 16, tuple({"ratio": 4, **SMALL}.items()), 8),
    "pu-net": Architecture("pu-net", 16, (("ratio", 4),), 8),
    "mpu": Architecture("mpu", 8, (("ratio", 4), ("growth", 8)), 8),
}


@pytest.fixture(scope="module", params=list(ARCHITECTURES))
def upsampler(request, tmp_path_factory):
    """Untrained weights of each network, saved and loaded again."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / f"{request.param}.safetensors"
    save(build_network(ARCHITECTURES[request.param]), {"name": request.param}, path)
    return Upsampler(path)


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """PUGeo-Net as training begins: even disks on the patches' principal planes."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "quiet.safetensors"
    save(build_network(ARCHITECTURES["pugeo-net"]), {"name": "quiet"}, path)
    return Upsampler(path)


def test_exactly_as_many_points_with_normals(upsampler, sphere):
    """Any ratio up to the network's own, unit normals, the same result every time."""
    for ratio in (1.0, 2.5, 4.0):
        result = upsampler(sphere, ratio)
        assert len(result.cloud.points) == round(ratio * len(sphere))
        lengths = np.linalg.norm(result.cloud.normals, axis=1)
        np.testing.assert_allclose(lengths, 1.0, atol=1e-4)
        assert result.report["patches"] == 24
    again = upsampler(sphere, 4.0)
    np.testing.assert_array_equal(again.cloud.points, result.cloud.points)


def test_the_patch_pipeline_on_a_sphere(quiet, sphere):
    """Untrained, samples lie on planes of patches: near the sphere, even, normals radial."""
    cloud = quiet(sphere, 4.0).cloud
    radius = np.linalg.norm(cloud.points, axis=1)
    spacing = np.sqrt(4 * np.pi / 2000)
    assert np.abs(radius - 1.0).max() < spacing
    cosine = (cloud.normals * cloud.points).sum(axis=1) / radius
    # A patch of 256 of 2,000 points is a cap of 42 degrees; normals all along its axis would be
    # off by two thirds of that.
    assert np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1))).mean() < 30
    assert (cosine > 0).mean() > 0.99
    octants = (cloud.points > 0) @ [1, 2, 4]
    np.testing.assert_allclose(np.bincount(octants) / len(octants), 1 / 8, atol=0.01)


def test_input_points_stay_where_asked(upsampler, sphere):
    """They lead, in their order, bit for bit; R=1 gives them normals."""
    for ratio in (1.0, 3.0):
        cloud = upsampler(sphere, ratio, keep_input=True).cloud
        np.testing.assert_array_equal(cloud.points[: len(sphere)], sphere)
        assert cloud.normals is not None


def test_scale_and_place_do_not_matter(quiet, sphere):
    """A cloud a thousand times as large and far away comes back just so."""
    near = quiet(sphere, 2.0).cloud
    far = quiet(Cloud(1000.0 * sphere + [5e5, 5e6, 100.0]), 2.0).cloud
    assert np.abs(far.points.mean(axis=0) - [5e5, 5e6, 100.0]).max() < 10.0
    assert len(near.points) == len(far.points)


def test_more_than_the_network_was_trained_for_is_refused(upsampler, sphere):
    """A network for R=4 says so at R=5."""
    with pytest.raises(BadOptionError, match="1 to 4 times"):
        upsampler(sphere, 5.0)


@pytest.mark.parametrize("count", [8, 40, 300])
def test_few_points(upsampler, sphere, count):
    """Clouds smaller than a patch, or hardly larger, are upsampled too."""
    cloud = upsampler(sphere[:: len(sphere) // count][:count], 4.0).cloud
    assert len(cloud.points) == 4 * count
    assert np.isfinite(cloud.points).all()


def test_tiles_give_all_points(quiet, sphere):
    """A cloud cut into tiles has as many points as asked for, and no gap between them."""
    plan = make_plan(Cloud(sphere), Options(4.0), tile_size=500, patch_ratio=4)
    assert len(plan.tile_specs) > 1
    cloud = quiet.upsample(plan).cloud
    assert len(cloud.points) == 8000
    octants = (cloud.points > 0) @ [1, 2, 4]
    np.testing.assert_allclose(np.bincount(octants) / len(octants), 1 / 8, atol=0.02)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"density": "even"}, "density"),
        ({"spacing": 0.1}, "spacing"),
        ({"max_gap": 0.1}, "max_gap"),
        ({"ratio": 1.0, "denoise": True}, "denoise"),
    ],
)
def test_options_that_need_charts_are_refused(quiet, sphere, options, name):
    """Such a network has no charts: options that need them say so."""
    with pytest.raises(BadOptionError, match=f"{name} must be left out: this network upsamples"):
        quiet(Cloud(sphere), **options)
