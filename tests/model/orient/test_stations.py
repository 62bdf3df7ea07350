# SPDX-License-Identifier: Apache-2.0
"""Directions to several scanner stations, and signs of normals by them."""

import numpy as np
import pytest

from pugeo_model.cloud import Cloud
from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.orient.signs import row_dots
from pugeo_model.orient.stations import (
    directions_to_stations,
    directions_to_visible_stations,
    orient_by_stations,
    station_numbers,
)

STATIONS = np.array([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("scalars", "expected"),
    [
        ({}, None),
        ({"scan": [0.0, 1.0, 1.0]}, [0, 1, 1]),
        ({"station": [1.0, 0.0, 1.0]}, [1, 0, 1]),
        ({"Scan_ID": [1.0, 2.0, 1.0]}, [0, 1, 0]),
        ({"scanner": [1.0, 1.0, 1.0]}, [1, 1, 1]),
        ({"scan": [0.0, 0.5, 1.0]}, None),
        ({"scan": [0.0, 1.0, 2.0]}, None),
        ({"scan": [-1.0, 0.0, 1.0]}, None),
        ({"scan": [0.0, np.nan, 1.0]}, None),
        ({"scan": [0.0, np.nan, 1.0], "station": [0.0, 0.0, 1.0]}, [0, 0, 1]),
    ],
)
def test_numbers_of_stations(scalars, expected):
    """Whole numbers of stations that there are, else none."""
    named = {name: np.array(values) for name, values in scalars.items()}
    found = station_numbers(Cloud(np.eye(3), scalars=named), 2)
    assert (None if found is None else found.tolist()) == expected


def test_directions_by_number():
    """The unit vector to the station that recorded the point, whatever lies between."""
    points = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-4.0, 3.0, 0.0]])
    found = directions_to_stations(points, STATIONS, np.array([0, 1, 1]))
    np.testing.assert_allclose(found, [[1, 0, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-6)


@pytest.fixture(scope="module")
def ball():
    """4,000 points spread evenly on the unit ball."""
    index = np.arange(4000) + 0.5
    height, turn = 1 - 2 * index / 4000, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    return np.stack([height, np.cos(turn) * ring, np.sin(turn) * ring], axis=1)


def visible(points):
    """Directions to the stations that see the points."""
    typical = float(np.median(spacing(nearest(points)[0][:, :8])))
    return directions_to_visible_stations(points, STATIONS, typical)


def test_directions_by_visibility(ball):
    """The near side of a ball is seen by a station, the far side is not."""
    found = visible(ball)
    for station, side in ((STATIONS[0], 1.0), (STATIONS[1], -1.0)):
        toward = station - ball
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        seen = row_dots(ball, toward) > 0.3
        right = np.abs(found[seen] - toward[seen]).max(axis=1) < 1e-5
        assert right.mean() > 0.99
        assert (found[ball[:, 0] * side > 0.5][:, 0] * side > 0).mean() > 0.99
    between = np.abs(ball[:, 0]) < 0.1  # beyond the horizon of both
    assert (np.linalg.norm(found[between], axis=1) < 1e-6).mean() > 0.9


def test_signs_by_stations(surfaces, ball):
    """Normals point towards the stations, up to the horizon that they see."""
    near = nearest(ball)[1][:, :10]
    found = orient_by_stations(surfaces.mixed(ball), visible(ball), near)
    assert (row_dots(found, ball) > 0)[np.abs(ball[:, 0]) > 0.3].all()
