# SPDX-License-Identifier: Apache-2.0
"""Normals of the input: use of them, and agreement of their signs."""

import numpy as np
import pytest

from pugeo_model import Cloud
from pugeo_model.options import Options
from pugeo_model.orient.given import signs_agree, usable_normals
from pugeo_model.plan import make_plan
from pugeo_model.upsampler import Upsampler


def test_single_bad_normals_are_unknown(sphere) -> None:
    """One NaN among thousands does not cost the others; it is zero, which stands for unknown."""
    normals = sphere.astype(np.float32)
    normals[7] = np.nan
    cloud = usable_normals(Cloud(sphere, normals))
    assert cloud.normals is not None
    assert cloud.normals[7].tolist() == [0, 0, 0]
    np.testing.assert_array_equal(cloud.normals[8:], sphere[8:].astype(np.float32))
    assert cloud.notes == (
        "1 of 2,000 normals are zero or not finite; neighbours decide their signs.",
    )


def test_good_normals_stay(sphere) -> None:
    """Normals of any length are used as they are."""
    cloud = Cloud(sphere, 3 * sphere.astype(np.float32))
    assert usable_normals(cloud) is cloud
    assert signs_agree(cloud)


def test_random_signs(sphere) -> None:
    """Signs by chance are noticed, and not used unless asked for."""
    signs = np.random.default_rng(0).choice([-1, 1], (len(sphere), 1))
    cloud = Cloud(sphere, (sphere * signs).astype(np.float32))
    assert not signs_agree(cloud)
    plan = make_plan(cloud, Options(2.0))
    assert plan.orient == "mst"
    assert "random signs" in plan.report["notes"][0]
    assert make_plan(cloud, Options(2.0, orient="input")).orient == "input"
    assert make_plan(cloud, Options(2.0, viewpoint=(0, 0, 9))).orient == "viewpoint"
    assert make_plan(Cloud(sphere, sphere.astype(np.float32)), Options(2.0)).orient == "input"


def test_a_thin_wall_agrees() -> None:
    """Both sides of a wall thinner than the spacing have opposite normals, rightly."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 1, (3000, 2))
    front = np.c_[flat, np.zeros(3000)]
    back = np.c_[rng.uniform(0, 1, (300, 2)), np.full(300, 0.02)]
    normals = np.repeat([[0, 0, -1], [0, 0, 1]], [3000, 300], axis=0).astype(np.float32)
    assert signs_agree(Cloud(np.concatenate([front, back]), normals))


@pytest.mark.parametrize("scans", [1, 2])
def test_viewpoints_of_the_file(scans: int) -> None:
    """Normals look to the scanner of their own scan: two sides of a wall are seen from two."""
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(0, 10, (1500, 2)), np.zeros(1500)]
    points = np.concatenate([wall, wall + [20, 0, 0]])
    places = np.array([[5.0, 5, 30], [25, 5, -30]])[:scans]
    scalars = {"scan": np.repeat(np.arange(2), 1500)} if scans == 2 else {}
    result = Upsampler()(Cloud(points, scalars=scalars, viewpoints=places), 2)
    assert result.report["orient"] == "viewpoint"
    normals = result.cloud.normals
    assert normals is not None
    second = result.cloud.points[:, 0] > 15
    assert (normals[~second, 2] > 0.9).all()
    assert (np.abs(normals[second, 2]) > 0.9).all()
    assert (normals[second, 2] > 0).all() == (scans == 1)
    assert result.cloud.viewpoints is not None
