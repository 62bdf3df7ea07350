# SPDX-License-Identifier: Apache-2.0
"""PTX: matrices, empty cells, several scans."""

import io
from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError
from pugeo_model.formats import read

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]
AXES = "1 0 0\n0 1 0\n0 0 1\n"
# A quarter turn about z for row vectors, then a move.
MATRIX = "0 1 0 0\n-1 0 0 0\n0 0 1 0\n500000 4000000 7 1\n"
SCAN = (
    f"2\n2\n500000 4000000 7\n{AXES}{MATRIX}"
    "1 2 3 0.25 10 20 30\n0 0 0 0.5 0 0 0\n4 5 6 0.75 1 2 255\n7 8 9 1 0 0 0\n"
)
MOVED = [[5e5 - 2, 4e6 + 1, 10], [5e5 - 5, 4e6 + 4, 13], [5e5 - 8, 4e6 + 7, 16]]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_one_scan(parse: Parse, end: str) -> None:
    """Points are moved by the matrix, empty cells go, the scanner is the viewpoint."""
    cloud = parse(SCAN.replace("\n", end).encode())
    assert cloud.points.tolist() == MOVED
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[10, 20, 30], [1, 2, 255], [0, 0, 0]]
    assert cloud.scalars["intensity"].tolist() == [0.25, 0.75, 1]
    assert cloud.viewpoints is not None
    assert cloud.viewpoints.tolist() == [[5e5, 4e6, 7]]
    assert cloud.notes == ("1 empty cells of the grid are left out.",)


def test_scans_with_and_without_colors(parse: Parse) -> None:
    """Scans follow each other; columns that one of them lacks are dropped with a note."""
    plain = f"1\n1\n0 0 0\n{AXES}1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 2 3 0.5\n"
    cloud = parse((SCAN + plain).encode())
    assert cloud.points.tolist() == [*MOVED, [1, 2, 3]]
    assert cloud.scalars["scan"].tolist() == [0, 0, 0, 1]
    assert cloud.colors is None
    assert cloud.scalars["intensity"].tolist() == [0.25, 0.75, 1, 0.5]
    assert "only some of the scans" in cloud.notes[1]


def test_round_trip(parse: Parse, dump: Dump) -> None:
    """Scans, scanners, colours and intensities come back."""
    cloud = parse((SCAN * 2).encode())
    back = parse(dump(cloud, "ptx"))
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(back.viewpoints, cloud.viewpoints)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    for name, values in cloud.scalars.items():
        np.testing.assert_array_equal(back.scalars[name], values)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("2\n2\n", "2\n3\n", "declares 6 cells, found 4"),
        ("2\n2\n", "2.5\n2\n", "2.5 columns"),
        ("2\n2\n", "-2\n2\n", "-2 columns"),
        ("0 0 1\n0 1 0 0", "0 0\n0 1 0 0", "header of a PTX scan is broken in line 6"),
        ("7 1\n", "nan 1\n", "not finite"),
        ("4 5 6 0.75 1 2 255", "4 5 6 0.75", "Line 13 has 4 numbers"),
        ("4 5 6 0.75 1 2 255", "4 5 6 0.75 1 2 x", "'x' is not a number"),
    ],
)
def test_broken_files(old: str, new: str, match: str) -> None:
    """A header or row that makes no sense is refused with its line."""
    assert old in SCAN
    with pytest.raises(MalformedFileError, match=match):
        read(io.BytesIO(SCAN.replace(old, new).encode()), format="ptx")


def test_limit(parse: Parse) -> None:
    """Cells of all scans together are bounded before they are read."""
    assert len(parse((SCAN * 2).encode(), max_points=8)) == 6
    with pytest.raises(LimitExceededError, match="Cells of the PTX scans"):
        parse((SCAN * 2).encode(), max_points=7)
    with pytest.raises(LimitExceededError):
        parse(SCAN.replace("2\n2\n", "4000000000\n4000000000\n").encode())
