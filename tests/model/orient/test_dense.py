# SPDX-License-Identifier: Apache-2.0
"""Signs by the points of the answer, where the input's neighbours mislead."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.orient.across_tiles import signs_across_tiles
from pugeo_model.orient.dense import orient_dense
from pugeo_model.orient.methods import orient

SIDE = 26


def grid(side: int, height: float, jitter: float, rng: np.random.Generator):
    """Points of a lattice in the unit square at a height."""
    axis = (np.arange(side) + 0.5) / side
    flat = np.stack(np.meshgrid(axis, axis), axis=2).reshape(-1, 2)
    flat = flat + jitter / side * rng.uniform(-1, 1, flat.shape)
    return np.column_stack([flat, np.full(len(flat), height)])


def plate(side: int, thickness: float, jitter: float, rng: np.random.Generator):
    """Both faces of a plate, points and outward normals."""
    faces = [grid(side, sign * thickness / 2, jitter, rng) for sign in (-1.0, 1.0)]
    points = np.concatenate(faces)
    return points, np.sign(points[:, 2:]) * np.array([[0.0, 0.0, 1.0]])


def mixed(normals, rng: np.random.Generator):
    """The same with signs by chance."""
    return (normals * rng.choice([-1.0, 1.0], (len(normals), 1))).astype(np.float32)


@pytest.mark.parametrize("members", [1, 3])
def test_a_wall_thinner_than_the_input_is_sparse(members):
    """Normals that lean make the faces of the input look like one; those of the answer do not.

    With nine points a chart, most follow those that take part.
    """
    rng = np.random.default_rng(members)
    points, truth = plate(SIDE, 0.7 / SIDE, 0.4, rng)
    dense, dense_truth = plate(members * SIDE, 0.7 / SIDE, 0.1, rng)
    leaning = truth + rng.normal(size=truth.shape)
    leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
    distances, near = nearest(points)
    near = np.ascontiguousarray(near[:, :12])
    area = surface_areas(spacing(distances), near)
    rows, core = np.arange(len(points), dtype=np.int32), np.ones(len(points), np.bool_)
    owner = np.asarray(cKDTree(points).query(dense)[1], dtype=np.int32)
    ways = mixed(dense_truth, rng)
    sides, signs, parts = orient_dense(
        rows, core, points, mixed(leaning, rng), near, area, (dense, ways, owner)
    )
    signs = signs * signs_across_tiles([sides])[0][parts]
    right = (ways * signs[:, None] * dense_truth).sum(axis=1) > 0
    face = dense[:, 2] > 0
    # Nothing joins the faces at their rims here: each is right within itself, or wrong.
    for mine in (face, ~face):
        assert max(right[mine].mean(), 1 - right[mine].mean()) > 0.98
    old, _ = orient(points, mixed(leaning, rng), "mst", None, None, near)
    left = (old * truth).sum(axis=1) > 0
    assert 0.05 < left[points[:, 2] > 0].mean() < 0.95


def test_a_margin_agrees_with_the_core():
    """Where there is no answer, neighbours in the input hand the signs on."""
    rng = np.random.default_rng(5)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    core = ball[:, 0] > -0.2
    dense = rng.normal(size=(9000, 3))
    dense /= np.linalg.norm(dense, axis=1, keepdims=True)
    owner = np.asarray(cKDTree(ball).query(dense)[1], dtype=np.int32)
    dense, owner = dense[core[owner]], owner[core[owner]]
    distances, near = nearest(ball)
    near = np.ascontiguousarray(near[:, :12])
    ways = mixed(dense, rng)
    sides, signs, parts = orient_dense(
        np.arange(3000, dtype=np.int32),
        core,
        ball,
        mixed(ball, rng),
        near,
        surface_areas(spacing(distances), near),
        (dense, ways, owner),
    )
    assert (sides.parts == 0).all()
    assert (parts == 0).all()
    inside = (sides.normals * ball).sum(axis=1) < 0
    assert inside.all() or not inside.any()
    assert (((ways * signs[:, None]) * dense).sum(axis=1) < 0).all() == inside.all()
    outward = signs_across_tiles([sides])[0]
    assert outward[0] == (-1.0 if inside.all() else 1.0)
