# SPDX-License-Identifier: Apache-2.0
"""Meaning of unnamed columns and of names, and layouts of text that other programs write."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pugeo_model import Cloud, MalformedFileError
from pugeo_model.errors import UntreatableCloudError
from pugeo_model.formats.meaning import from_array, guess, standard_name

Parse = Callable[..., Cloud]
ROWS = 200
RNG = np.random.default_rng(5)
P = np.round(RNG.normal(size=(ROWS, 3)), 4)
N = P / np.linalg.norm(P, axis=1, keepdims=True)
C = RNG.integers(0, 256, (ROWS, 3)).astype(float)
I = np.arange(ROWS, dtype=float)[:, None]  # noqa: E741 - an index
SMALL = np.c_[I % 5, I % 3, I % 31]


def text(separator: str, *columns: NDArray[np.float64]) -> str:
    """Lines of these columns."""
    table = np.column_stack(columns)
    return "".join(separator.join(f"{v:.17g}" for v in row) + "\n" for row in table)


@pytest.mark.parametrize(
    ("columns", "colors", "normals", "scalars"),
    [
        ([P], False, False, []),
        ([P, C], True, False, []),
        ([P, N], False, True, []),
        ([P, np.where(I == 3, 0, N)], False, True, []),
        ([P, np.where(I == 3, np.nan, N)], False, True, []),
        ([P, C, N], True, True, []),
        ([P, N, C], True, True, []),
        ([P, C / 255], True, False, []),
        ([P, C / 255, N], True, True, []),
        ([P, N, C / 255], True, True, []),
        ([P, C * 257], True, False, []),
        ([P, C, I % 9], True, False, ["c6"]),
        ([P, C, np.full((ROWS, 1), 255.0)], True, False, ["c6"]),
        ([P, I / 7, C], True, False, ["intensity"]),
        ([P, I * 100, C], True, False, ["intensity"]),
        ([P, C, I % 9, I / 7], True, False, ["c6", "c7"]),
        ([P, SMALL], False, False, ["c3", "c4", "c5"]),
        ([P, I * 20, SMALL], False, False, ["c3", "c4", "c5", "c6"]),
        ([P, np.full((ROWS, 3), 0.5), I], False, False, ["c3", "c4", "c5", "c6"]),
        ([P, C, np.full((ROWS, 1), np.nan)], True, False, []),
    ],
)
def test_guesses(
    columns: Sequence[NDArray[np.float64]], colors: bool, normals: bool, scalars: list[str]
) -> None:
    """Colours, normals and scalars are told by their values, in each usual order, with notes."""
    cloud = guess(np.column_stack(columns))
    assert (cloud.colors is not None, cloud.normals is not None) == (colors, normals)
    assert list(cloud.scalars) == scalars
    assert len(cloud.notes) == colors + normals + bool(scalars)
    if cloud.colors is not None:
        wide = np.uint16(257) if cloud.colors.dtype == np.uint16 else np.uint8(1)
        np.testing.assert_array_equal(cloud.colors // wide, C)


def test_pts_has_intensity_first() -> None:
    """After a count of points, the seven columns are intensity and colours, dark ones as well."""
    cloud = guess(np.column_stack([P, np.full((ROWS, 1), 9.0), SMALL]), counted=True)
    assert cloud.colors is not None
    np.testing.assert_array_equal(cloud.colors, SMALL)
    assert list(cloud.scalars) == ["intensity"]


@pytest.mark.parametrize("shape", [(5,), (5, 2), (5, 3, 1)])
def test_arrays_of_other_shapes(shape: tuple[int, ...]) -> None:
    """Only tables of three or more numeric columns are clouds."""
    with pytest.raises(UntreatableCloudError, match="must hold numbers of shape"):
        from_array(np.zeros(shape))
    with pytest.raises(UntreatableCloudError):
        from_array(np.zeros((5, 3), "U4"))


def test_types_of_arrays() -> None:
    """Single and half precision are float32, all else float64."""
    kinds = {"f2": "f4", "f4": "f4", "f8": "f8", "i4": "f8", "u1": "f8"}
    for given, expected in kinds.items():
        assert from_array(np.zeros((5, 3), given)).points.dtype == np.dtype(expected)


@pytest.mark.parametrize(
    ("name", "standard"),
    [
        *[(each, "x") for each in ("X", "x", "Easting", "X [m]", "x(m)", "Points_X", "Longitude")],
        *[("Rf", "red"), ("R", "red"), ("Green", "green"), ("Nx", "nx"), ("normal_y", "ny")],
        *[("NormalZ", "nz"), ("Elevation", "z"), ("intensity", None), ("label", None), ("", None)],
    ],
)
def test_standard_names(name: str, standard: str | None) -> None:
    """Usual names of coordinates, colours and normals are known in any case, with units."""
    assert standard_name(name) == standard


COUNT = f"{ROWS}\n"
LAYOUTS: dict[str, tuple[str, bool, bool, list[str]]] = {
    "PDAL": ('"X","Y","Z","Red","Green","Blue"\n' + text(",", P, C), True, False, []),
    "a data frame with its index": (",x,y,z\n" + text(",", I, P), False, False, []),
    "count, then names": (COUNT + "//X Y Z R G B\n" + text(" ", P, C), True, False, []),
    "names, then count": (
        "//X;Y;Z;Rf;Gf;Bf;Nx;Ny;Nz\n" + COUNT + text(";", P, C / 255, N),
        *(True, True, []),
    ),
    "a name with a blank": (
        "//X Y Z R G B Illuminance (PCV)\n" + text(" ", P, C, I / 7),
        *(True, False, ["Illuminance (PCV)"]),
    ),
    "a last name of two words": (
        "//X Y Z Scalar field\n" + text(" ", P, I / 7),
        *(False, False, ["Scalar field"]),
    ),
    "byte order mark": ("\ufeffx,y,z\n" + text(",", P), False, False, []),
    "names not first": (
        "timestamp,X,Y,Z,reflectivity\n" + text(",", I, P, I),
        *(False, False, ["timestamp", "reflectivity"]),
    ),
    "a map": ("Easting,Northing,Elevation\n" + text(",", P), False, False, []),
    "spaces around names": ("x , y , z , q\n" + text(" , ", P, I), False, False, ["q"]),
    "tabs and units": ("X [m]\tY [m]\tZ [m]\n" + text("\t", P), False, False, []),
    "COLMAP without tracks": (
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR\n" + text(" ", I, P, C, I / 7),
        *(True, False, ["POINT3D_ID", "ERROR"]),
    ),
    "a comment between": (
        "# one\n# x y z R G B\n# in metres\n\n" + text(" ", P, C),
        *(True, False, []),
    ),
}


@pytest.mark.parametrize("utf16", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts(parse: Parse, layout: str, utf16: bool) -> None:
    """Text as other programs write it is read with its names, in UTF-8 and in UTF-16."""
    content, colors, normals, scalars = LAYOUTS[layout]
    data = content.removeprefix("\ufeff").encode("utf-16") if utf16 else content.encode()
    cloud = parse(data)
    np.testing.assert_array_equal(cloud.points, P)
    assert (cloud.colors is not None, cloud.normals is not None) == (colors, normals)
    assert list(cloud.scalars) == scalars
    if cloud.colors is not None:
        np.testing.assert_array_equal(cloud.colors, C)


def test_colmap_with_tracks(parse: Parse) -> None:
    """Tracks of any length after the named columns are dropped with a note."""
    lines = text(" ", I, P, C, I / 7).splitlines()
    tracks = "".join(f"{line} {'1 2 ' * (k % 5)}\n" for k, line in enumerate(lines))
    head = "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    cloud = parse(("# points: 200, mean track length: 3\n" + head + tracks).encode())
    np.testing.assert_array_equal(cloud.points, P)
    np.testing.assert_array_equal(cloud.colors, C)
    assert list(cloud.scalars) == ["POINT3D_ID", "ERROR"]
    assert cloud.notes == ("The tracks of COLMAP's points are dropped.",)


def test_blank_cells(parse: Parse) -> None:
    """A blank cell is a missing value, first, between or last; a column of them goes."""
    cloud = parse(b"x,y,z,a,b\n1,2,3,,5\n4,5,6,7,\n,8,9,1,2\n")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6], [np.nan, 8, 9]])
    np.testing.assert_array_equal(cloud.scalars["a"], [np.nan, 7, 1])
    np.testing.assert_array_equal(cloud.scalars["b"], [5, np.nan, 2])
    assert parse(b"1;2;3;\n4;5;6;\n").scalars == {}


def test_blank_cells_across_blocks(parse: Parse) -> None:
    """Blank cells are found wherever a block of the file ends."""
    lines = [f"{k},0.5,-1,{'' if k % 3 else k},{'' if k % 2 else 7}" for k in range(60_000)]
    cloud = parse(("x,y,z,a,b\n" + "\n".join(lines)).encode())
    k = np.arange(60_000)
    np.testing.assert_array_equal(cloud.points[:, 0], k)
    np.testing.assert_array_equal(cloud.scalars["a"], np.where(k % 3, np.nan, k))
    np.testing.assert_array_equal(cloud.scalars["b"], np.where(k % 2, np.nan, 7))


def test_degrees_by_name(parse: Parse) -> None:
    """Columns named longitude and latitude give a warning."""
    cloud = parse(b"Longitude,Latitude,Altitude\n8.5,47.3,400\n8.6,47.4,410\n")
    assert cloud.points.tolist() == [[8.5, 47.3, 400], [8.6, 47.4, 410]]
    assert "degrees" in cloud.notes[0]


def test_black_and_white_floats(parse: Parse) -> None:
    """Rf, Gf, Bf promise 0..1, also where all values are 0 and 1."""
    cloud = parse(b"//X,Y,Z,Rf,Gf,Bf\n1,2,3,0,1,1\n4,5,6,1,0,0\n")
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [[0, 255, 255], [255, 0, 0]]


def test_broken_utf16(parse: Parse) -> None:
    """Text that begins as UTF-16 and is not is refused."""
    with pytest.raises(MalformedFileError):
        parse(b"\xff\xfe1\x00 \x002\x00 \x003\x00\n\x00\x00\xd8\x00\xd8")
