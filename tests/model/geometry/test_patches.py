# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import MESSAGES, edges, extract_patch, poses


def patch_of(points, core):
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    return extract_patch(core, points, neighbours, frames), neighbours, frames


def test_rings_hold_all_neighbours(sphere):
    """All senders of a round have features from the round before."""
    patch, neighbours, _ = patch_of(sphere, np.arange(0, 300, 3, dtype=np.int32))
    limits = (*patch.rings, patch.core)
    for number, columns in enumerate(MESSAGES):
        rows, before = limits[number + 1], limits[number]
        assert patch.neighbours[:rows, slice(*columns)].max() < before
    assert patch.neighbours.max() < len(patch.rows)
    np.testing.assert_array_equal(
        patch.rows[patch.neighbours], neighbours[patch.rows[: patch.rings[0]]]
    )


def test_edges_are_in_frame_and_spacings(sphere):
    """The first three features of an edge are the offset in the frame, in spacings."""
    patch, _, _ = patch_of(sphere, np.arange(50, dtype=np.int32))
    got = edges(patch)
    offset = patch.points[patch.neighbours[7, 3]] - patch.points[7]
    expected = patch.frames.axes[7] @ offset / patch.frames.spacing[7]
    np.testing.assert_allclose(got[3, 7, :3], expected, atol=1e-5)
    np.testing.assert_allclose(got[3, 7, 4], np.linalg.norm(expected), rtol=1e-5)


def test_edges_ignore_rotation_scale_and_place(sphere):
    """The features are invariant to translation, rotation and scale of the cloud."""
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    core = np.arange(200, dtype=np.int32)
    rough = sphere * (1 + 0.1 * np.sin(5 * sphere[:, :1]))
    receiver_point = edges(patch_of(rough, core)[0])
    sender_point = edges(patch_of(37.0 * rough @ rotation.T + [1e5, -2e5, 3e5], core)[0])
    close = np.isclose(receiver_point, sender_point, atol=2e-3).all(axis=(0, 2))
    assert close.mean() > 0.97  # the signs of a symmetric neighbourhood are arbitrary


def test_relative_poses(sphere):
    """A pose has the relative rotation of both frames and the offset in both frames."""
    patch, _, _ = patch_of(sphere, np.arange(50, dtype=np.int32))
    pose = poses(patch, 50, MESSAGES[0])[2, 11]
    other = patch.neighbours[11, 2]
    f = patch.frames
    np.testing.assert_allclose(pose[3:12].reshape(3, 3), f.axes[11] @ f.axes[other].T, atol=1e-5)
    offset = patch.points[other] - patch.points[11]
    np.testing.assert_allclose(pose[:3], f.axes[11] @ offset / f.spacing[11], atol=1e-5)
    np.testing.assert_allclose(pose[12:15], -(f.axes[other] @ offset) / f.spacing[other], atol=1e-4)


def test_fits_of_neighbours_show_an_outlier(sphere):
    """The fits of its neighbours give the height and the normal at a point off the surface."""
    moved = sphere.copy()
    lifted = 20
    distances, _ = nearest(sphere)
    spaced = float(spacing(distances)[lifted])
    moved[lifted] *= 1 + 0.1 * spaced
    patch, _, _ = patch_of(moved, np.arange(50, dtype=np.int32))
    out = np.sign(patch.frames.axes[lifted, 2] @ sphere[lifted])
    pose = poses(patch, 50, (0, 12, 1))
    suggested = pose[:, lifted, 16] / 4 * out
    # The point influences the fits of its neighbours a little.
    assert -0.13 < suggested.mean() < -0.05
    # Tangents of the true normal, in the frame, of either sign.
    tangents = patch.frames.axes[lifted, :2] @ sphere[lifted] * out
    np.testing.assert_allclose(pose[:, lifted, 17:19].mean(axis=0), tangents, atol=0.05)
    others = [i for i in range(50) if i != lifted and lifted not in patch.neighbours[i]]
    assert np.abs(pose[:, others, 16]).max() < 0.02
    assert np.abs(pose[:, others, 19]).max() < 0.02


def test_features_of_fits_by_definition(sphere):
    """Features 16 to 19 equal their definition in float64, on a rough cloud."""
    rough = sphere + 0.01 * np.random.default_rng(0).normal(size=sphere.shape)
    patch, _, _ = patch_of(rough, np.arange(50, dtype=np.int32))
    frames = patch.frames

    def height(q, u, v):
        return q @ [1, u, v, u * u / 2, u * v, v * v / 2]

    pose = poses(patch, 50, (0, 12, 1))
    for i, k in ((0, 0), (7, 3), (33, 11)):
        j = patch.neighbours[i, k]
        receiver, sender = frames.axes[i].astype(float), frames.axes[j].astype(float)
        receiver_point, sender_point = patch.points[i], patch.points[j]
        u, v, h = sender @ (receiver_point - sender_point) / frames.spacing[j]
        q = frames.quadric[j].astype(float)
        cosine = receiver[2] @ sender[2]
        rise = (height(q, u, v) - h) * cosine * frames.spacing[j] / frames.spacing[i]
        assert pose[k, i, 16] == pytest.approx(4 * rise, abs=1e-4)
        slope = np.array([q[1] + q[3] * u + q[4] * v, q[2] + q[4] * u + q[5] * v])
        normal = sender[2] - slope @ sender[:2]
        normal *= cosine / np.linalg.norm(normal)
        np.testing.assert_allclose(pose[k, i, 17:19], receiver[:2] @ normal, atol=1e-4)
        u, v, h = receiver @ (sender_point - receiver_point) / frames.spacing[i]
        above = h - height(frames.quadric[i].astype(float), u, v)
        assert pose[k, i, 19] == pytest.approx(4 * above, abs=1e-4)
