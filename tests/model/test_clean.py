# SPDX-License-Identifier: Apache-2.0
"""Cleaning: dropped points are counted, the others unchanged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from numpy.typing import NDArray

import pugeo_model.clean
from pugeo_model import Cloud
from pugeo_model.clean import Dropped, clean


def test_order_and_attributes_are_kept() -> None:
    """Non-finite rows and later duplicates are dropped with their attributes."""
    points = np.array(
        [
            [1, 2, 3],
            [np.nan, 0, 0],
            [0, 0, 0],
            [1, 2, 3],
            [0, np.inf, 0],
            [5, 5, 5],
            [0, 0, -np.inf],
        ]
    )
    cloud, dropped = clean(
        Cloud(
            points,
            np.ones((7, 3), np.float32),
            np.arange(21, dtype=np.uint8).reshape(7, 3),
            {"id": np.arange(7)},
            ("a note",),
        )
    )
    assert dropped == Dropped(non_finite=3, duplicate=1)
    assert cloud.scalars["id"].tolist() == [0, 2, 5]
    assert cloud.points.tolist() == [[1, 2, 3], [0, 0, 0], [5, 5, 5]]
    assert cloud.colors is not None
    assert cloud.colors[:, 0].tolist() == [0, 6, 15]
    assert cloud.notes == ("a note",)


def test_clean_cloud_is_not_copied() -> None:
    """If no point is dropped, the result is the same object."""
    cloud = Cloud(np.random.default_rng(0).random((100, 3)))
    assert clean(cloud) == (cloud, Dropped(0, 0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_signed_zeros_are_equal(dtype: type[np.floating]) -> None:
    """-0.0 is where 0.0 is, and the first of both stays."""
    points = np.array([[-0.0, 0, 1], [0.0, -0.0, 1], [0, 0, -1]], dtype)
    cloud, dropped = clean(Cloud(points))
    assert dropped == Dropped(0, 1)
    assert np.signbit(cloud.points[0, 0])


def test_absurd_but_finite_points_stay() -> None:
    """Coordinates near the largest float are finite, neighbours in the last bit are different."""
    largest = np.finfo(np.float64).max
    points = np.array([[largest, 0, 0], [-largest, 0, 0], [np.nextafter(largest, 0), 0, 0]])
    assert clean(Cloud(points))[1] == Dropped(0, 0)


def test_nothing_left() -> None:
    """A cloud of no points, or of none that is finite, is cleaned to no points."""
    for points in (np.empty((0, 3)), np.full((3, 3), np.nan)):
        cloud, dropped = clean(Cloud(points, np.zeros((len(points), 3), np.float32)))
        assert len(cloud) == 0
        assert dropped == Dropped(len(points), 0)


@pytest.mark.parametrize(
    ("normals", "note"),
    [
        ([[0, np.nan, 1]] * 2, "The normals are left out: 2 of 2 are zero or not finite."),
        ([[0, 0, 0], [0, 0, 0]], "The normals are left out: all are zero."),
        ([[0, 0, 255], [9, 8, 7]], "The normals are left out: they are whole numbers in 0..255"),
    ],
)
def test_unusable_normals(normals: list[list[float]], note: str) -> None:
    """Normals that are not finite, zero or colours are dropped with a note; points are kept."""
    cloud, dropped = clean(Cloud(np.eye(3)[:2], np.array(normals, np.float32)))
    assert dropped == Dropped(0, 0)
    assert cloud.notes[0].startswith(note)
    assert cloud.normals is None


def test_bad_normal_of_a_dropped_point() -> None:
    """A bad normal of a dropped point does not drop the other normals."""
    points = np.array([[np.nan, 0, 0], [1, 2, 3]])
    cloud, _ = clean(Cloud(points, np.array([[np.nan] * 3, [0, 0, 1]], np.float32)))
    assert cloud.normals is not None


ROWS = st.sampled_from([np.float32, np.float64]).flatmap(
    lambda dtype: nps.arrays(
        dtype,
        # Of so few points none is wild.
        st.tuples(st.integers(0, 23), st.just(3)),
        elements=st.sampled_from([0.0, -0.0, 1.0, 1.0000001, -1e30, np.nan, np.inf]),
    )
)


def by_hand(points: NDArray[np.floating]) -> tuple[list[int], int, int]:
    """Clean with a set of tuples, row by row."""
    seen: set[tuple[float, ...]] = set()
    keep, non_finite, duplicate = [], 0, 0
    for index, row in enumerate(points.tolist()):
        key = tuple(each + 0.0 for each in row)
        if not np.isfinite(row).all():
            non_finite += 1
        elif key in seen:
            duplicate += 1
        else:
            seen.add(key)
            keep.append(index)
    return keep, non_finite, duplicate


@given(points=ROWS, collide=st.booleans())
def test_agrees_with_a_set(points: NDArray[np.floating], collide: bool) -> None:
    """Result and counts are those of a Python set, even when all hashes collide."""
    keep, non_finite, duplicate = by_hand(points)
    with pytest.MonkeyPatch.context() as patch:
        if collide:
            patch.setattr(pugeo_model.clean, "_hash", lambda rows: np.zeros(len(rows), np.uint64))
        cloud, dropped = clean(Cloud(points))
    np.testing.assert_array_equal(cloud.points, points[keep])
    assert dropped == Dropped(non_finite, duplicate)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_million_points(share: float) -> None:
    """A million points are cleaned, also with half of them duplicates."""
    points = np.random.default_rng(0).random((1_000_000, 3))
    points[: int(share * len(points))] = points[-1]
    _, dropped = clean(Cloud(points))
    assert dropped.duplicate == int(share * len(points))
