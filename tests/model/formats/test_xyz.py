# SPDX-License-Identifier: Apache-2.0
"""Text: layouts that are read, meanings that are guessed, faults that are refused."""

from collections.abc import Callable

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "1 2 3\r\n4 5 6",
        "1 2 3\r4 5 6\r",
        "1,2,3\n4,5,6\n",
        "1, 2, 3\n4, 5, 6\n",
        "1;2;3\n4;5;6\n",
        "\t1\t2\t3 \n\n4\t5\t6\n\n",
        "# a comment\n1 2 3 # and one more\n4 5 6\n",
        "// CloudCompare\n1 2 3\n4 5 6\n",
        "2\n1 2 3\n4 5 6\n",
        "# pts\n2\n1 2 3\n4 5 6\n",
        "x y z\n1 2 3\n4 5 6\n",
        "X,Y,Z\n1,2,3\n4,5,6\n",
        "//X Y Z\n2\n1 2 3\n4 5 6\n",
        "# x y z in metres\n1 2 3\n4 5 6\n",
    ],
)
def test_points(parse: Parse, text: str) -> None:
    """Separators, comments, counts, names and line ends of all kinds read the same."""
    cloud = parse(text.encode())
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.points.dtype == np.float64
    assert (cloud.normals, cloud.colors, cloud.scalars, cloud.notes) == (None, None, {}, ())


def test_six_columns_of_unit_length(parse: Parse) -> None:
    """Three more columns of unit length are normals."""
    cloud = parse(b"1 2 3 0 0.6 0.8\n4 5 6 0 0 -1\n")
    assert cloud.normals is not None
    np.testing.assert_array_equal(cloud.normals, np.array([[0, 0.6, 0.8], [0, 0, -1]], np.float32))
    assert cloud.notes == ("Columns 4 to 6 have unit length and were read as normals.",)


def test_six_columns_of_bytes(parse: Parse) -> None:
    """Three more columns of whole numbers up to 255 are colours."""
    cloud = parse(b"1 2 3 0 128 255\n4 5 6 1 0 0\n")
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[0, 128, 255], [1, 0, 0]]


def test_pts_with_intensity(parse: Parse) -> None:
    """The seven columns of a PTS file are intensity and colour."""
    cloud = parse(b"2\n1 2 3 -1500 0 128 255\n4 5 6 17 1 1 1\n")
    assert cloud.colors is not None
    assert cloud.scalars["intensity"].tolist() == [-1500.0, 17.0]
    assert cloud.scalars["intensity"].dtype == np.float64


def test_other_columns_are_scalars(parse: Parse) -> None:
    """Other columns are kept: labels where all values are whole numbers."""
    cloud = parse(b"1 2 3 0.5 7\n4 5 6 1.5 8\n")
    assert cloud.scalars["c3"].tolist() == [0.5, 1.5]
    assert cloud.scalars["c4"].tolist() == [7, 8]
    assert cloud.scalars["c4"].dtype == np.int64
    assert cloud.notes == ("Unnamed columns were read as scalars: c3, c4.",)
    six = parse(b"1 2 3 300 1 1\n4 5 6 0 1 2.5\n")
    assert list(six.scalars) == ["c3", "c4", "c5"]


def test_named_columns(parse: Parse) -> None:
    """Named columns mean what they mean in PLY; capitals of scalars are kept."""
    cloud = parse(b"X,Y,Z,Red,Green,Blue,Intensity,class\n1,2,3,9,8,7,0.5,2\n4,5,6,1,2,3,0.25,3\n")
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[9, 8, 7], [1, 2, 3]]
    assert cloud.scalars["Intensity"].tolist() == [0.5, 0.25]
    assert cloud.scalars["class"].dtype == np.int64


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1 2 3\n4 5 6\n7 8\n", "Line 3 has 2 numbers, expected 3"),
        ("# c\n1 2 3\n\n4 5 6 7\n", "Line 4 has 4 numbers, expected 3"),
        ("1 2 3\n4 five 6\n", "Line 2: 'five' is not a number"),
        ("3\n1 2 3\n4 5 6\n", "counts 3 points, found 2"),
        ("1.5\n1 2 3\n", "must be a count"),
        ("-1\n1 2 3\n", "must be a count"),
        ("x y z w\n1 2 3\n", "names 4 columns"),
        ("x y z x\n1 2 3 4\n", "one of them twice"),
        ("1,5 2,5 3,5\n", "Decimal commas"),
        ("1,5;2,5;3,5\n", "Decimal commas"),
        ("1 2 3\n" + "4 " * 300 + "\n", "Line 2 has 300 numbers"),
    ],
)
def test_bad_text(parse: Parse, text: str, match: str) -> None:
    """Ragged rows, words, wrong counts and decimal commas are refused with their line."""
    with pytest.raises(MalformedFileError, match=match):
        parse(text.encode())


def test_limit(parse: Parse) -> None:
    """The limit of points holds with a count and without."""
    for text in (b"0 0 0\n" * 11, b"11\n" + b"0 0 0\n" * 11):
        assert len(parse(text, max_points=11)) == 11
        with pytest.raises(LimitExceededError):
            parse(text, max_points=10)


def test_rows_beyond_the_count(parse: Parse) -> None:
    """Rows after the counted ones are ignored, with a note."""
    cloud = parse(b"1\n1 2 3\n4 5 6\n")
    assert len(cloud) == 1
    assert "ignored" in cloud.notes[0]


def test_many_blocks_and_comments(parse: Parse) -> None:
    """Comments across the borders of blocks neither vanish into rows nor shift line numbers."""
    rows = [f"{index} 0.125 -1 # row {index} {'x' * (index % 90)}" for index in range(40_000)]
    cloud = parse("\n".join(rows).encode())
    np.testing.assert_array_equal(cloud.points[:, 0], np.arange(40_000))
    rows[33_333] = "1 2 x"
    with pytest.raises(MalformedFileError, match=r"Line 33334: 'x'"):
        parse("\n".join(rows).encode())


def test_round_trip(rich: Cloud, parse: Parse, dump: Dump) -> None:
    """Named columns come back with their names."""
    back = parse(dump(rich, "xyz"))
    np.testing.assert_array_equal(back.points.astype(np.float32), rich.points)
    assert back.normals is not None
    np.testing.assert_array_equal(back.normals, rich.normals)
    assert back.colors is not None
    np.testing.assert_array_equal(back.colors, rich.colors)
    assert list(back.scalars) == list(rich.scalars)
    for name, values in rich.scalars.items():
        np.testing.assert_array_equal(back.scalars[name].astype(values.dtype), values)
    bare = dump(Cloud(rich.points), "xyz")
    assert not bare.startswith(b"#")
    assert len(parse(bare)) == 7
