# SPDX-License-Identifier: Apache-2.0
"""Signs from output points, where neighbours in the input mislead."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.geometry.areas import surface_areas
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.orient.across_tiles import signs_across_tiles
from pugeo_model.orient.dense import orient_dense
from pugeo_model.orient.mst import Edges
from pugeo_model.orient.mst_consensus import join_by_consensus
from pugeo_model.orient.signed_union_find import SignedUnionFind

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
    """The normals with random signs, float32."""
    return (normals * rng.choice([-1.0, 1.0], (len(normals), 1))).astype(np.float32)


@pytest.mark.parametrize("members", [1, 3])
def test_a_wall_thinner_than_the_input_is_sparse(members):
    """With inaccurate normals the faces of the input cannot be separated, those of the output can.

    With nine output points per chart, most of them get their sign from another one.
    """
    rng = np.random.default_rng(members)
    points, truth = plate(SIDE, 0.7 / SIDE, 0.4, rng)
    dense, dense_truth = plate(members * SIDE, 0.7 / SIDE, 0.1, rng)
    inaccurate = truth + rng.normal(size=truth.shape)
    inaccurate /= np.linalg.norm(inaccurate, axis=1, keepdims=True)
    distances, near = nearest(points)
    near = np.ascontiguousarray(near[:, :12])
    area = surface_areas(spacing(distances), near)
    rows, core = np.arange(len(points), dtype=np.int32), np.ones(len(points), np.bool_)
    owner = np.asarray(cKDTree(points).query(dense)[1], dtype=np.int32)
    normals = mixed(dense_truth, rng)
    tile, signs, parts = orient_dense(
        rows, core, points, mixed(inaccurate, rng), near, area, (dense, normals, owner)
    )
    signs = signs * signs_across_tiles([tile])[0][parts]
    correct = (normals * signs[:, None] * dense_truth).sum(axis=1) > 0
    upper = dense[:, 2] > 0
    # The faces are not connected at their rims, so that a whole face may have the wrong sign.
    for face in (upper, ~upper):
        assert max(correct[face].mean(), 1 - correct[face].mean()) > 0.98
    union_find = SignedUnionFind(len(points))
    join_by_consensus(union_find, Edges.among(points, mixed(inaccurate, rng), near))
    by_input = union_find.read()[0] * np.sign((mixed(inaccurate, rng) * truth).sum(axis=1))
    assert 0.05 < (by_input > 0)[points[:, 2] > 0].mean() < 0.95


def test_a_margin_agrees_with_the_core():
    """In the margin, which has no output points, signs propagate along input neighbours."""
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
    normals = mixed(dense, rng)
    tile, signs, parts = orient_dense(
        np.arange(3000, dtype=np.int32),
        core,
        ball,
        mixed(ball, rng),
        near,
        surface_areas(spacing(distances), near),
        (dense, normals, owner),
    )
    assert (tile.parts == 0).all()
    assert (parts == 0).all()
    inward = (tile.normals * ball).sum(axis=1) < 0
    assert inward.all() or not inward.any()
    assert (((normals * signs[:, None]) * dense).sum(axis=1) < 0).all() == inward.all()
    outward = signs_across_tiles([tile])[0]
    assert outward[0] == (-1.0 if inward.all() else 1.0)
