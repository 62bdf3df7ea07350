# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

pytest.importorskip("igl", reason="samples of solids need the evaluate extra")

from pugeo_model.network.build import build_network
from pugeo_model.network.local_surface import LocalSurfaces, _differentiate
from pugeo_model.network.pugeo import Architecture
from pugeo_model.reproduce.geometry import _metric_error, draw_histograms, local_surfaces, verify
from pugeo_model.reproduce.solids import cube, sphere
from pugeo_model.weights import save

SMALL = Architecture("pugeo-net", 16, (("ratio", 4), ("k", 8), ("width", 8), ("fused", 16)), 8)


def paraboloid(T):
    """Local surfaces ``delta = (3 u^2 - v^2) / 2`` of two points with the same T."""
    rows = np.arange(2, dtype=np.int32)
    step = np.full(2, 0.01)
    return _differentiate(
        rows,
        np.broadcast_to(T, (2, 3, 3)),
        np.zeros((2, 4, 2)),
        np.full((2, 4), 0.5),
        lambda u, v: 0.5 * (3 * (u * step) ** 2 - (v * step) ** 2),
        step,
    )


def test_curvatures_of_a_paraboloid():
    """Second derivatives 3 and -1 are its principal curvatures; its first form is the identity."""
    found = paraboloid(np.eye(3))
    np.testing.assert_allclose(found.principal_curvatures, [[-1, 3]] * 2, atol=1e-6)
    np.testing.assert_allclose(found.first_form, [np.eye(2)] * 2, atol=1e-9)
    np.testing.assert_allclose(found.axis_angle, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.displacement, 0.5)


def test_curvature_does_not_depend_on_the_parameterization():
    """(u, v) stretched by 2 and 4 along t1, t2: curvatures divided by their squares."""
    found = paraboloid(np.diag([2.0, 4.0, 1.0]))
    np.testing.assert_allclose(found.principal_curvatures, [[-1 / 16, 3 / 4]] * 2, atol=1e-6)
    np.testing.assert_allclose(found.first_form, [np.diag([4.0, 16.0])] * 2, atol=1e-9)


def test_the_angle_of_t3():
    """45 degrees for t3 = (1, 0, 1); its sign is free, and the displacement counts its length."""
    T = np.array([[1.0, 0, 1], [0, 1, 0], [0, 0, 1]])
    for sign in (1.0, -1.0):
        found = paraboloid(T * [1, 1, sign])
        np.testing.assert_allclose(found.axis_angle, 45.0)
        np.testing.assert_allclose(found.displacement, 0.5 * np.sqrt(2))


def test_the_metric_of_the_true_surface():
    """A tilted plane over T = I is stretched by 1 / cos^2 along the slope, which I lacks."""
    found = paraboloid(np.eye(3))
    tilt = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    stretched = 1 / np.cos(0.3) ** 2
    wanted = (stretched - 1) / np.sqrt(stretched**2 + 1)
    np.testing.assert_allclose(_metric_error(found, np.tile(tilt, (2, 1))), wanted, rtol=1e-6)
    np.testing.assert_allclose(_metric_error(found, np.tile([0, 0, 1.0], (2, 1))), 0, atol=1e-9)


def test_solids():
    """Points on the surface, normals outward; a cube's know how far its edges are."""
    ball, box = sphere(500), cube(600)
    np.testing.assert_allclose(np.linalg.norm(ball.points, axis=1), 0.5)
    np.testing.assert_allclose(ball.normals, 2 * ball.points)
    np.testing.assert_allclose(np.abs(box.points).max(axis=1), 0.5)
    np.testing.assert_allclose((box.points * box.normals).sum(axis=1), 0.5)
    assert box.flat.min() >= 0
    assert box.flat.max() <= 0.5
    row = int(np.abs(box.points - [0.5, 0.0, 0.0]).sum(axis=1).argmin())
    assert box.flat[row] == pytest.approx(0.5, abs=0.1)


def test_the_served_network_knows_a_sphere():
    """Normals within half a degree, curvature within a tenth: released weights, 2,000 points."""
    solid = sphere(2000)
    found = local_surfaces("standard", solid.points, 4)
    assert sorted(found.rows) == list(range(2000))
    normals, true = found.T[:, :, 2], solid.normals[found.rows]
    assert np.degrees(np.arccos(np.abs((normals * true).sum(1)).clip(max=1))).mean() < 0.5
    assert np.abs(found.principal_curvatures).mean() == pytest.approx(2.0, rel=0.1)


@pytest.mark.slow
def test_the_papers_network(tmp_path):
    """Untrained: T is the patches' principal axes, so that angles are small; histograms appear."""
    torch.manual_seed(0)
    path = tmp_path / "paper.safetensors"
    save(build_network(SMALL), {"name": "paper"}, path)
    found = list(verify(path, 4, count=1200))
    assert [each.name for each in found] == ["sphere", "cube"]
    for each in found:
        numbers = each.numbers()
        assert numbers["angle median"] < 3.0
        assert numbers["stretch mean"] == pytest.approx(1.0, abs=0.1)
        assert all(np.isfinite(value) for value in numbers.values())
    draw_histograms(found, tmp_path / "histograms.png")
    assert (tmp_path / "histograms.png").stat().st_size > 10_000


def test_a_network_without_a_linear_map(tmp_path):
    """There is nothing to verify, and it says so."""
    path = tmp_path / "pu_net.safetensors"
    save(build_network(Architecture("pu-net", 16, (("ratio", 4),), 8)), {"name": "x"}, path)
    with pytest.raises(ValueError, match="predicts no T"):
        local_surfaces(path, sphere(300).points, 4)


def test_all_fields_are_known():
    """Local surfaces of several patches are joined field by field."""
    assert {"T", "displacement", "samples", "rows"} <= set(LocalSurfaces.__dataclass_fields__)
