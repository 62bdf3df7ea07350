# SPDX-License-Identifier: Apache-2.0
"""Spanning trees with votes, and the outer side of each connected part."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.orient.across_tiles import signs_across_tiles, tile_signs
from pugeo_model.orient.mst import Edges
from pugeo_model.orient.mst_consensus import join_by_consensus
from pugeo_model.orient.signed_union_find import SignedUnionFind
from pugeo_model.orient.signs import row_dots


def orient(points, normals, neighbours):
    """Orient a cloud that is a single tile, as `orient_dense` orients input points."""
    points = points - points.mean(axis=0)
    union_find = SignedUnionFind(len(points))
    join_by_consensus(union_find, Edges.among(points, normals, neighbours))
    signs, parts = union_find.read()
    rows, core = np.arange(len(points), dtype=np.int32), np.ones(len(points), dtype=np.bool_)
    tile = tile_signs(rows, core, points, normals, signs, parts, neighbours)
    return tile.normals * signs_across_tiles([tile])[0][parts, None].astype(np.float32)


def near(points, count=13):
    """Neighbours as a k-d tree gives them: the point itself first."""
    return np.asarray(cKDTree(points).query(points, k=count)[1])


def correct(found, truth):
    """Fraction of the normals with the true sign."""
    return float((row_dots(found, truth) > 0).mean())


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_closed_surfaces(surfaces, offset):
    """Ball, torus, cube and thin plate are oriented outward; the normals keep their axes."""
    shapes = [
        (surfaces.ball(2000), surfaces.ball(2000)),
        surfaces.torus(3000),
        surfaces.box(3000, (1, 1, 1)),
        surfaces.box(6000, (1, 1, 0.02)),
    ]
    for points, normals in shapes:
        found = orient(points + offset, surfaces.mixed(normals), near(points))
        assert correct(found, normals) > 0.99
        np.testing.assert_array_equal(np.abs(found), np.abs(normals.astype(np.float32)))


def test_noise(surfaces):
    """Points that noise puts above each other do not flip whole regions."""
    points, normals = surfaces.torus(3000)
    rng = np.random.default_rng(0)
    points = points + rng.normal(size=points.shape) * 0.01
    tilted = normals + rng.normal(size=normals.shape) * 0.1
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    assert correct(orient(points, surfaces.mixed(tilted), near(points)), normals) > 0.98


def test_open_surfaces(surfaces):
    """A horizontal plate points up, a wall has one side, a dome points outward."""
    plate = np.random.default_rng(0).random((500, 3)) * [1, 1, 0]
    up = np.tile([0.0, 0, 1], (500, 1))
    assert (orient(plate, surfaces.mixed(up), near(plate))[:, 2] == 1).all()
    wall = plate[:, [2, 0, 1]]
    found = orient(wall, surfaces.mixed(up[:, [2, 0, 1]]), near(wall))
    assert len(np.unique(found[:, 0])) == 1
    dome = surfaces.ball(2000)
    dome = dome[dome[:, 2] > 0]
    assert correct(orient(dome, surfaces.mixed(dome), near(dome)), dome) == 1.0


def test_many_parts(surfaces):
    """Each connected part is oriented on its own: thirty distant balls."""
    normals = np.concatenate([surfaces.ball(100, seed) for seed in range(30)])
    points = normals + np.repeat(np.arange(30), 100)[:, None] * np.array([10.0, 3.0, 0.0])
    assert correct(orient(points, surfaces.mixed(normals), near(points, 10)), normals) > 0.99


def test_a_path(surfaces):
    """A path of 20,000 edges, the deepest possible tree, is consistent from end to end."""
    angle = np.arange(20_000) * 1e-4
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rows = np.arange(20_000)
    found = orient(points, surfaces.mixed(points), np.stack([rows, rows + 1], 1))
    assert correct(found, points) in (0.0, 1.0)


def test_neighbours_may_be_missing(surfaces):
    """The point itself and numbers outside the cloud are skipped; equal points are allowed."""
    points = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [9, 9, 9]])
    normals = np.tile([0.0, 0, 1], (4, 1))
    rows = np.array([[0, 1, 4], [1, 0, -1], [2, 0, 4], [3, 4, 4]])
    np.testing.assert_array_equal(orient(points, surfaces.mixed(normals), rows), normals)


def test_memory_is_linear(surfaces):
    """100,000 points are oriented with less than 400 bytes per neighbour."""
    points, normals = surfaces.torus(100_000)
    rows, mixed = near(points), surfaces.mixed(normals)
    assert correct(orient(points, mixed, rows), normals) > 0.99
    tracemalloc.start()
    orient(points, mixed, rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400 * rows.size
