# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing


def frames_of(points):
    distances, neighbours = nearest(points)
    return fit_frames(points, neighbours, spacing(distances))


def angles(normals, truth):
    return np.degrees(np.arccos(np.abs((normals * truth).sum(axis=1)).clip(0, 1)))


def test_axes_are_rotations(cylinder):
    """Each frame is orthonormal and right-handed."""
    axes = frames_of(cylinder).axes.astype(np.float64)
    np.testing.assert_allclose(
        axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (len(axes), 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-5)


def test_plane_is_exact(plane):
    """On a plane the normal is that of the plane, and the noise level is zero."""
    points, normal = plane
    frames = frames_of(points)
    assert angles(frames.axes[:, 2], normal).max() < 0.01
    assert frames.noise < 1e-6


def test_sphere_curvature(sphere):
    """On the unit sphere both principal curvatures are 1, per spacing."""
    frames = frames_of(sphere)
    assert angles(frames.axes[:, 2], sphere).max() < 0.5
    curvature = np.abs(frames.quadric[:, [3, 5]]) / frames.spacing[:, None]
    assert np.median(curvature) == pytest.approx(1.0, rel=0.1)


def test_cylinder_curvatures(cylinder):
    """A cylinder of radius 0.5 has the principal curvatures 2 and 0 away from its rims."""
    inner = (cylinder[:, 2] > 0.4) & (cylinder[:, 2] < 1.6)
    frames = frames_of(cylinder)
    c3, c4, c5 = frames.quadric[inner, 3:].T / frames.spacing[inner]
    form = np.stack([np.stack([c3, c4], -1), np.stack([c4, c5], -1)], axis=-2)
    low, high = np.sort(np.abs(np.linalg.eigvalsh(form)), axis=1).T
    assert np.median(high) == pytest.approx(2.0, rel=0.1)
    assert np.median(low) < 0.1


def test_noise_is_measured(sphere):
    """The noise estimate grows with the noise and ignores scale."""
    rng = np.random.default_rng(0)
    rough = [frames_of(sphere + rng.normal(0, sigma, sphere.shape)).noise for sigma in (0, 0.01)]
    assert rough[1] > 5 * rough[0]
    assert frames_of(1000 * sphere).noise == pytest.approx(rough[0], rel=1e-3)


def test_frames_follow_rotation(sphere):
    """A rotation of the cloud rotates the normals."""
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    before, after = frames_of(sphere), frames_of(sphere @ rotation.T)
    assert angles(after.axes[:, 2], before.axes[:, 2] @ rotation.T).max() < 0.1


def test_noise_is_told_from_detail(plane):
    """A plane with bumps in one half has a low noise level, a noisy plane a high one."""
    points, normal = plane
    rough = np.arange(len(points)) < len(points) // 2
    height = np.random.default_rng(0).normal(size=(len(points), 1), scale=0.008)
    bumpy = points + rough[np.argsort(np.argsort(points[:, 0])), None] * height * normal
    assert frames_of(bumpy).noise < 0.02
    assert frames_of(points + height * normal).noise > 0.1
