# SPDX-License-Identifier: Apache-2.0
"""Largest distance of output points from the input: between its points, and beyond its rim."""

import numpy as np

from pugeo_model.geometry.neighbours import nearest, spacing
from pugeo_model.resample.bounds import are_beyond, bounded_spacing, distance_bounds
from pugeo_model.tuning import TUNING

_UP = np.array([0, 0, 1], np.float32)


def _plate() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), -1).reshape(-1, 2)
    points = np.c_[grid, np.zeros(400)]
    distances, neighbours = nearest(points)
    return points, neighbours, spacing(distances)


def _bound(
    point: list[float],
    owner: int,
    *,
    normal: np.ndarray = _UP,
    gap: float | None = None,
    **how: bool,
) -> tuple[float, int]:
    points, neighbours, apart = _plate()
    limit, chart = distance_bounds(
        np.array([point]),
        normal[None],
        np.array([owner], np.int32),
        points,
        neighbours,
        apart,
        gap,
        **how,
    )
    return float(limit[0]), int(chart[0])


def test_between_points_the_wide_bound_holds() -> None:
    """In the middle of a plate the bound is the wide one, from the nearest chart."""
    limit, chart = _bound([10.4, 10.3, 0.0], 209, shadows=False)
    assert chart == 210
    assert np.isclose(limit, TUNING.largest_offset * _plate()[2][210])


def test_beyond_the_rim_the_narrow_bound_holds() -> None:
    """Outside of a plate the bound is the narrow one."""
    limit, chart = _bound([-1.6, 10.3, 0.0], 200, shadows=False)
    assert chart == 200
    assert np.isclose(limit, TUNING.rim_offset * _plate()[2][200])


def test_a_point_between_other_surfaces_has_the_narrow_bound() -> None:
    """A point whose surroundings are not along its tangent plane must be near, if asked for."""
    upright = np.array([1, 0, 0], np.float32)
    limit, chart = _bound([10.5, 10.5, 0.0], 210, normal=upright, shadows=True)
    assert np.isclose(limit, TUNING.rim_offset * _plate()[2][chart])
    limit, chart = _bound([10.5, 10.5, 0.0], 210, normal=upright, shadows=False)
    assert np.isclose(limit, TUNING.largest_offset * _plate()[2][chart])


def test_the_largest_gap_bounds_all_distances() -> None:
    """The caller's bound holds where it is the smaller one."""
    assert _bound([10.4, 10.3, 0.0], 209, gap=0.2, shadows=False)[0] == 0.2


def test_points_beyond_their_bound_are_found() -> None:
    """Points within their bound are not beyond, others are."""
    points, neighbours, apart = _plate()
    asked = np.array([[10.4, 10.3, 0.0], [-0.4, 10.0, 0.0], [-1.9, 10.0, 0.0]])
    owner = np.array([210, 200, 200], np.int32)
    normals = np.tile(_UP, (3, 1))
    far = are_beyond(asked, normals, owner, points, neighbours, apart, None, shadows=False)
    assert far.tolist() == [False, False, True]


def test_a_point_that_expects_a_larger_error_must_be_nearer() -> None:
    """Half-way between four charts a point may expect a small error, not a large one."""
    points, neighbours, apart = _plate()
    asked = np.tile([10.5, 10.5, 0.0], (3, 1))
    owner = np.full(3, 210, np.int32)
    normals = np.tile(_UP, (3, 1))
    error = np.array([0.0, 1.0, 4.0], np.float32) * TUNING.sure_error
    far = are_beyond(
        asked, normals, owner, points, neighbours, apart, None, shadows=False, error=error
    )
    assert far.tolist() == [False, False, True]


def test_the_spacing_of_an_isolated_chart_is_bounded() -> None:
    """A spacing much larger than those around is reduced, others stay."""
    _, neighbours, apart = _plate()
    wide = apart.copy()
    wide[210] *= 5.0
    bounded = bounded_spacing(wide, neighbours)
    assert bounded[210] < 1.5 * apart[210]
    assert np.isclose(bounded[189], apart[189])
