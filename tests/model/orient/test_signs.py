# SPDX-License-Identifier: Apache-2.0
"""Signs from directions, from the input's normals and from other normals."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pugeo_model.orient.signs import orient_along, orient_by_input, row_dots, transfer_signs


def near(points, count=10):
    """Neighbours as a k-d tree gives them: the point itself first, ``M`` if there is none."""
    return np.asarray(cKDTree(points).query(points, k=count)[1])


def test_along_directions(surfaces):
    """Normals point towards a viewpoint inside a ball, or away from its centre."""
    points = surfaces.ball(500)
    mixed = surfaces.mixed(points)
    inward = orient_along(mixed, np.array([0.1, 0.0, 0.0]) - points)
    assert (row_dots(inward, points) < 0).all()
    assert (row_dots(orient_along(mixed, points), points) > 0).all()
    assert inward.dtype == np.float32


def test_a_perpendicular_direction_gives_plus():
    """The sign of a zero dot product is 1, so that no normal becomes zero."""
    normals = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(orient_along(normals, np.array([[1.0, 0.0, 0.0]])), normals)


def test_by_the_normals_of_the_input(surfaces):
    """Input normals of any length decide; where they are zero, the neighbours do."""
    points = surfaces.ball(1000)
    given = -3.0 * points
    given[::7] = 0.0
    found = orient_by_input(surfaces.mixed(points), given, near(points))
    assert (row_dots(found, points) < 0).all()


def test_neighbours_outside_the_cloud_are_skipped():
    """Row numbers -1 and M have no vote."""
    normals = np.tile([0.0, 0.0, 1.0], (2, 1))
    given = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    found = orient_by_input(normals, given, np.array([[-1, 2], [0, 1]]))
    np.testing.assert_array_equal(found[:, 2], [1.0, -1.0])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_points(surfaces, count):
    """No, one and two points are oriented as well."""
    points = surfaces.ball(3)[:count]
    assert orient_along(points, points).shape == (count, 3)
    assert orient_by_input(points, points, np.zeros((count, 2), np.intp)).shape == (count, 3)


def test_transfer(surfaces):
    """A dense normal gets the sign of the nearest oriented normal, and nothing else of it."""
    points, dense = surfaces.ball(300), surfaces.ball(5000, 1)
    nearest = np.asarray(cKDTree(points).query(dense)[1])
    found = transfer_signs(surfaces.mixed(dense), nearest, points.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, dense, atol=1e-6)
