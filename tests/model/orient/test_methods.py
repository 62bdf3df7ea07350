# SPDX-License-Identifier: Apache-2.0
"""Which way normals point."""

import time
import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pugeo_model import BadOptionError
from pugeo_model.orient.methods import METHODS, orient, transfer_signs

Array = NDArray[np.floating]


def near(points: Array, count: int = 10) -> NDArray[np.intp]:
    """Neighbours as a k-d tree gives them: the point itself first, ``M`` where there is none."""
    return np.asarray(cKDTree(points).query(points, k=count)[1])


def shuffled(normals: Array, seed: int = 0) -> NDArray[np.float32]:
    """Flip half of the normals."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (len(normals), 1))
    flipped: NDArray[np.float32] = (normals * signs).astype(np.float32)
    return flipped


def ball(count: int, seed: int = 0) -> Array:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points


def torus(count: int) -> tuple[Array, Array]:
    u, v = np.random.default_rng(1).random((2, count)) * 2 * np.pi
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    return np.stack([np.cos(u), np.sin(u), 0 * u], axis=1) + 0.4 * normals, normals


def box(count: int, size: tuple[float, float, float]) -> tuple[Array, Array]:
    """Points on the faces of a box, with sharp edges."""
    rng = np.random.default_rng(2)
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=area / area.sum())
    side = rng.choice([-1.0, 1.0], count)
    points = (rng.random((count, 3)) - 0.5) * size
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side
    points[np.arange(count), axis] = side * np.array(size)[axis] / 2
    return points, normals


def right(found: Array, true: Array) -> float:
    return float((np.einsum("ij,ij->i", found, true) > 0).mean())


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_tree_on_closed_surfaces(offset: float) -> None:
    """Ball, torus (no convex shape), cube and thin plate are all oriented outward."""
    shapes = [(ball(2000), ball(2000)), torus(3000), box(3000, (1, 1, 1)), box(6000, (1, 1, 0.02))]
    for points, normals in shapes:
        found, method = orient(
            points + offset, shuffled(normals), "mst", None, None, near(points, 13)
        )
        assert method == "mst"
        assert found.dtype == np.float32
        assert right(found, normals) > 0.99
        np.testing.assert_array_equal(np.abs(found), np.abs(normals.astype(np.float32)))


def test_tree_with_noise() -> None:
    """Points above each other, as noise puts them, do not turn whole regions around."""
    points, normals = torus(3000)
    rng = np.random.default_rng(0)
    points = points + rng.normal(size=points.shape) * 0.01
    tilted = normals + rng.normal(size=normals.shape) * 0.1
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    found, _ = orient(points, shuffled(tilted), "mst", None, None, near(points, 13))
    assert right(found, normals) > 0.98


def test_tree_on_open_surfaces() -> None:
    """A flat plate looks up, a wall has one side, a dome looks outward."""
    rng = np.random.default_rng(0)
    plate = rng.random((500, 3)) * [1, 1, 0]
    found, _ = orient(
        plate, shuffled(np.tile([0.0, 0, 1], (500, 1))), "mst", None, None, near(plate)
    )
    assert (found[:, 2] == 1).all()
    wall = plate[:, [2, 0, 1]]
    found, _ = orient(wall, shuffled(np.tile([1.0, 0, 0], (500, 1))), "mst", None, None, near(wall))
    assert len(np.unique(found[:, 0])) == 1
    dome = ball(2000)
    dome = dome[dome[:, 2] > 0]
    found, _ = orient(dome, shuffled(dome), "mst", None, None, near(dome))
    assert right(found, dome) == 1.0


def test_tree_on_many_parts() -> None:
    """Every connected part is oriented on its own: thirty balls far from each other."""
    normals = np.concatenate([ball(100, seed) for seed in range(30)])
    points = normals + np.repeat(np.arange(30), 100)[:, None] * np.array([10.0, 3.0, 0.0])
    found, _ = orient(points, shuffled(normals), "mst", None, None, near(points))
    assert right(found, normals) > 0.99


def test_tree_along_a_line() -> None:
    """A path of 20,000 edges, the deepest tree there is, agrees from end to end, and is quick."""
    angle = np.arange(20_000) * 1e-4
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rows = np.arange(20_000)
    start = time.perf_counter()
    found, _ = orient(points, shuffled(points), "mst", None, None, np.stack([rows, rows + 1], 1))
    assert time.perf_counter() - start < 5.0
    assert right(found, points) in (0.0, 1.0)


def test_neighbours_may_be_missing() -> None:
    """The point itself, padding and lonely points are no neighbours; equal points no trouble."""
    points = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [9, 9, 9]])
    normals = np.tile([0.0, 0, 1], (4, 1))
    rows = np.array([[0, 1, 4], [1, 0, -1], [2, 0, 4], [3, 4, 4]])
    found, _ = orient(points, shuffled(normals), "mst", None, None, rows)
    np.testing.assert_array_equal(found, normals)


def test_viewpoint_and_outward() -> None:
    """Towards a scanner inside the ball, or away from the centre."""
    points = ball(500)
    mixed = shuffled(points)
    inward, _ = orient(points, mixed, "viewpoint", (0.1, 0.0, 0.0), None, near(points))
    assert right(inward, -points) == 1.0
    outward, _ = orient(points + 1e6, mixed, "outward", None, None, near(points))
    assert right(outward, points) == 1.0


def test_input_normals() -> None:
    """The file's own normals decide, whatever their length; where they are zero, neighbours do."""
    points = ball(1000)
    given = -3.0 * points
    given[::7] = 0.0
    found, method = orient(points, shuffled(points), "input", None, given, near(points))
    assert method == "input"
    assert right(found, -points) == 1.0


def test_auto_and_none() -> None:
    """What there is decides: the file's normals, then a viewpoint, then the tree."""
    points = ball(200)
    mixed, rows = shuffled(points), near(points)
    assert orient(points, mixed, "auto", (0, 0, 9), points, rows)[1] == "input"
    assert orient(points, mixed, "auto", (0, 0, 9), None, rows)[1] == "viewpoint"
    assert orient(points, mixed, "auto", None, None, rows)[1] == "mst"
    found, method = orient(points, mixed, "none", None, points, rows)
    assert method == "none"
    np.testing.assert_array_equal(found, mixed)


def test_bad_options() -> None:
    """Unknown methods and missing or non-finite needs are refused by name."""
    points = ball(20)
    rows = near(points)
    for method, viewpoint, name in (
        ("up", None, "orient"),
        ("viewpoint", None, "viewpoint"),
        ("viewpoint", (0.0, np.nan, 0.0), "viewpoint"),
        ("auto", (0.0, np.inf, 0.0), "viewpoint"),
        ("input", None, "orient"),
    ):
        with pytest.raises(BadOptionError) as caught:
            orient(points, points, method, viewpoint, None, rows)
        assert caught.value.fields["name"] == name


@pytest.mark.parametrize("method", [each for each in METHODS if each != "input"])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_points(method: str, count: int) -> None:
    """No, one or two points are oriented as well."""
    points = ball(3)[:count]
    rows = np.zeros((count, 2), np.intp)
    found, _ = orient(points, points, method, (1.0, 2.0, 3.0), None, rows)
    assert found.shape == (count, 3)


def test_propagate() -> None:
    """Dense normals take the sign of their nearest sparse one, and nothing else of it."""
    points, dense = ball(300), ball(5000, 1)
    nearest = np.asarray(cKDTree(points).query(dense)[1])
    found = transfer_signs(shuffled(dense), nearest, points.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, dense, atol=1e-6)


def test_speed_and_memory() -> None:
    """100,000 points take a second or so, and memory linear in their neighbours."""
    points, normals = torus(100_000)
    rows = near(points, 13)
    mixed = shuffled(normals)
    start = time.perf_counter()
    found, _ = orient(points, mixed, "mst", None, None, rows)
    assert time.perf_counter() - start < 20.0
    assert right(found, normals) > 0.99
    tracemalloc.start()
    orient(points, mixed, "mst", None, None, rows)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400 * rows.size
