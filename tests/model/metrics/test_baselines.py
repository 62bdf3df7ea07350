# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

pytest.importorskip("igl", reason="evaluation needs the evaluate extra")

from pugeo_model.cloud import Cloud
from pugeo_model.metrics import baselines
from pugeo_model.metrics.clouds import evenness


@pytest.mark.parametrize("method", [baselines.plane, baselines.jet])
def test_a_plane_is_exact(method, plane):
    """Both fits give even points in the plane, with its normal."""
    points, normal = plane
    dense = method(Cloud(points), 4)
    assert len(dense) == 4 * len(points)
    assert np.abs(dense.points @ normal).max() < 1e-6
    assert np.abs(dense.normals @ normal).min() > 1 - 1e-6
    assert evenness(dense.points) < 0.13


@pytest.mark.parametrize("ratio", [1.5, 4, 7.3])
def test_any_ratio(ratio, sphere):
    """The number of points is round(R M), as in the pipeline."""
    dense = baselines.plane(Cloud(sphere), ratio)
    assert len(dense) == int(np.floor(ratio * len(sphere) + 0.5))


def test_charts_project_onto_their_surface():
    """Three exact quadrics of a unit sphere project points above it onto it, with its normals."""
    spacing = 0.05
    pole = np.array([0.0, 0.0, 1.0])
    points, axes = [], []
    for angle in (0.0, 0.05, -0.05):
        normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
        first = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        points.append(normal)
        axes.append([first, np.cross(normal, first), normal])
    quadric = np.tile([0, 0, 0, -spacing, 0, -spacing], (3, 1))  # h = -s (u^2 + v^2) / 2
    charts = baselines._Charts(np.array(points), np.array(axes), np.full(3, spacing), quadric)
    others = np.array([[1, 2], [0, 2], [0, 1]], dtype=np.int32)
    queries = 1.02 * pole + np.random.default_rng(0).uniform(-0.03, 0.03, (50, 3)) * [1, 1, 0]
    projected = charts.project(queries, np.zeros(50, dtype=np.int32), others)
    np.testing.assert_allclose(np.linalg.norm(projected.points, axis=1), 1.0, atol=2e-6)
    np.testing.assert_allclose(projected.normals, projected.points, atol=2e-3)
    near = np.linalg.norm(queries[:, None] - points, axis=2).argmin(axis=1)
    assert (projected.nearest == near).all()


def test_a_quadric_knows_curvature(sphere):
    """On a sphere the normals of jets are several times as accurate as those of planes."""
    errors = []
    for method in (baselines.plane, baselines.jet):
        dense = method(Cloud(sphere), 4)
        unit = dense.points / np.linalg.norm(dense.points, axis=1, keepdims=True)
        errors.append(np.degrees(np.arccos((dense.normals * unit).sum(axis=1).clip(-1, 1))).mean())
    assert errors[1] < errors[0] / 3


def test_place_and_scale_do_not_matter(sphere):
    """Translation and scale of the input give the same translation and scale of the output."""
    near = baselines.jet(Cloud(sphere), 4)
    far = baselines.jet(Cloud(100 * sphere + [5e5, 0, 0]), 4)
    np.testing.assert_allclose((far.points - [5e5, 0, 0]) / 100, near.points, atol=1e-6)


def test_poisson_resamples_the_sphere(sphere):
    """Reconstruction gives exactly R M even points on the sphere, normals outward."""
    pytest.importorskip("pycolmap", reason="reconstruction needs the evaluate extra")
    dense = baselines.poisson(Cloud(0.5 * sphere[::2]), 3)
    assert len(dense) == 3 * len(sphere[::2])
    radius = np.linalg.norm(dense.points, axis=1)
    assert np.abs(radius - 0.5).mean() < 2e-3
    assert ((dense.normals * dense.points).sum(axis=1) / radius).min() > 0.9
    assert evenness(dense.points) < 0.11
