# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from pugeo_model.geometry.frames import fit_frames
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.geometry.patches import MESSAGES, ROUNDS, cut, edges, poses


def patch_of(points, core, rounds=ROUNDS):
    distances, neighbours = nearest(points)
    frames = fit_frames(points, neighbours, spacing(distances))
    return cut(core, points, neighbours, frames, rounds), neighbours, frames


@pytest.mark.parametrize(("cut_for", "rounds"), [(2, 2), (3, 3), (3, 2)])
def test_rings_hold_all_neighbours(sphere, cut_for, rounds):
    """Each ring's rows find all senders of their round within the ring before."""
    core = np.arange(0, 300, 3, dtype=np.int32)
    patch, neighbours, _ = patch_of(sphere, core, cut_for)
    patch = patch.inner(rounds)
    limits = (*patch.rings, patch.core)
    assert len(limits) == rounds + 1
    assert len(patch.neighbours) == len(patch.frames.axes) == patch.rings[0]
    for turn, reach in enumerate(MESSAGES[-rounds:]):
        rows, before = limits[turn + 1], limits[turn]
        assert patch.neighbours[:rows, slice(*reach)].max() < before
    assert patch.neighbours.max() < len(patch.rows)
    np.testing.assert_array_equal(
        patch.rows[patch.neighbours], neighbours[patch.rows[: patch.rings[0]]]
    )


def test_edges_are_in_frame_and_spacings(sphere):
    """An edge's first three numbers are the neighbour's offset, turned and scaled."""
    patch, _, _ = patch_of(sphere, np.arange(50, dtype=np.int32))
    got = edges(patch)
    offset = patch.points[patch.neighbours[7, 3]] - patch.points[7]
    expected = patch.frames.axes[7] @ offset / patch.frames.spacing[7]
    np.testing.assert_allclose(got[3, 7, :3], expected, atol=1e-5)
    np.testing.assert_allclose(got[3, 7, 4], np.linalg.norm(expected), rtol=1e-5)


def test_edges_ignore_rotation_scale_and_place(sphere):
    """The network's inputs are the same wherever, however large and however turned a cloud is."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    core = np.arange(200, dtype=np.int32)
    rough = sphere * (1 + 0.1 * np.sin(5 * sphere[:, :1]))
    here = edges(patch_of(rough, core)[0])
    there = edges(patch_of(37.0 * rough @ turn.T + [1e5, -2e5, 3e5], core)[0])
    close = np.isclose(here, there, atol=2e-3).all(axis=(0, 2))
    assert close.mean() > 0.97  # signs of a perfectly symmetric neighbourhood may fall either way


def test_pose_of_a_frame_seen_from_itself(sphere):
    """A pose's rotation is the product of both frames, its positions seen from both sides."""
    patch, _, _ = patch_of(sphere, np.arange(50, dtype=np.int32))
    pose = poses(patch, 50, (0, 12, 1))[2, 11]
    other = patch.neighbours[11, 2]
    f = patch.frames
    np.testing.assert_allclose(pose[3:12].reshape(3, 3), f.axes[11] @ f.axes[other].T, atol=1e-5)
    offset = patch.points[other] - patch.points[11]
    np.testing.assert_allclose(pose[:3], f.axes[11] @ offset / f.spacing[11], atol=1e-5)
    np.testing.assert_allclose(pose[12:15], -(f.axes[other] @ offset) / f.spacing[other], atol=1e-4)
