# SPDX-License-Identifier: Apache-2.0
"""PLY as it is met in the wild, every variant built byte by byte."""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pugeo_model import Cloud
from pugeo_model.formats import read

Parse = Callable[..., Cloud]

XYZ = ["property float x", "property float y", "property float z"]
ROWS = np.array([[0.5, -1.25, 2.0], [3.0, 4.5, -5.75]], np.float32)
LITTLE, BIG, TEXT = "binary_little_endian", "binary_big_endian", "ascii"


def ply(lines: list[str], body: bytes, kind: str = LITTLE, end: str = "\n") -> bytes:
    return end.join(["ply", f"format {kind} 1.0", *lines, "end_header", ""]).encode() + body


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("kind", [LITTLE, BIG, TEXT])
def test_encodings_and_line_ends(parse: Parse, kind: str, end: str) -> None:
    """All three encodings read the same under all three line endings."""
    body = {
        LITTLE: ROWS.astype("<f4").tobytes(),
        BIG: ROWS.astype(">f4").tobytes(),
        TEXT: f"0.5 -1.25 2{end}3 4.5 -5.75{end}".encode(),
    }[kind]
    cloud = parse(ply(["element vertex 2", *XYZ], body, kind, end))
    np.testing.assert_array_equal(cloud.points, ROWS)
    assert cloud.points.dtype == np.float32
    assert cloud.notes == ()


@pytest.mark.parametrize("kind", [LITTLE, BIG, TEXT])
@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("char", "i1"),
        ("int8", "i1"),
        ("uchar", "u1"),
        ("uint8", "u1"),
        ("short", "i2"),
        ("int16", "i2"),
        ("ushort", "u2"),
        ("uint16", "u2"),
        ("int", "i4"),
        ("int32", "i4"),
        ("uint", "u4"),
        ("uint32", "u4"),
        ("int64", "i8"),
        ("uint64", "u8"),
        ("float", "f4"),
        ("float32", "f4"),
        ("double", "f8"),
        ("float64", "f8"),
    ],
)
def test_scalar_types(parse: Parse, kind: str, name: str, code: str) -> None:
    """Every type name is known, as coordinate (exactly, as double) and as scalar (as it is)."""
    order = "<" if kind == LITTLE else ">"
    body = struct.pack(order + "ff", 1, 2) + np.array([3, 99], order + code).tobytes()
    if kind == TEXT:
        body = b"1 2 3 99"
    cloud = parse(
        ply(["element vertex 1", *XYZ[:2], f"property {name} z", f"property {name} q"], body, kind)
    )
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.points.dtype == (np.float32 if code == "f4" else np.float64)
    assert cloud.scalars["q"].tolist() == [99]
    assert cloud.scalars["q"].dtype == np.dtype(code)


def test_double_coordinates_stay_exact(parse: Parse) -> None:
    """UTM coordinates keep all their digits, in binary and in text."""
    utm = np.array([[448262.123456789, 5411932.987654321, 251.000000001]])
    lines = ["element vertex 1"] + [line.replace("float", "double") for line in XYZ]
    assert np.array_equal(parse(ply(lines, utm.tobytes())).points, utm)
    text = " ".join(map(repr, utm[0].tolist())).encode()
    assert np.array_equal(parse(ply(lines, text, TEXT)).points, utm)


@pytest.mark.parametrize("kind", [LITTLE, BIG, TEXT])
@pytest.mark.parametrize("lengths", [(3, 3, 3, 3), (0, 5, 2, 70), (4, 4, 4, 1), (0, 0, 0, 0)])
@pytest.mark.parametrize("count_type", ["uchar", "int", "uint", "short"])
def test_lists_on_vertices(
    parse: Parse, kind: str, lengths: tuple[int, ...], count_type: str
) -> None:
    """Lists between and after values are passed over, of equal length or not."""
    order = "<" if kind == LITTLE else ">"
    code = {"uchar": "B", "int": "i", "uint": "I", "short": "h"}[count_type]
    body, expected = b"", []
    for row, length in enumerate(lengths):
        numbers = [row + 0.5, row + 0.25, -row]
        views, weights = list(range(length)), [0.5] * (length // 2)
        if kind == TEXT:
            cells = [*numbers[:2], length, *views, numbers[2], len(weights), *weights, 7 * row]
            body += (" ".join(map(str, cells)) + "\n").encode()
        else:
            body += struct.pack(f"{order}ff{code}{length}i", *numbers[:2], length, *views)
            body += struct.pack(
                f"{order}fB{len(weights)}dH", numbers[2], len(weights), *weights, 7 * row
            )
        expected.append([*numbers, 7 * row])
    lines = [
        "element vertex 4",
        *XYZ[:2],
        f"property list {count_type} int views",
        XYZ[2],
        "property list uchar double weights",
        "property ushort tail",
    ]
    cloud = parse(ply(lines, body, kind))
    np.testing.assert_array_equal(np.column_stack([cloud.points, cloud.scalars["tail"]]), expected)
    assert cloud.notes == ("List properties of the vertices are dropped: views, weights.",)


def test_lists_across_chunks(parse: Parse) -> None:
    """Rows of different length are found beyond the first megabytes, and agree with plyfile."""
    rng = np.random.default_rng(0)
    count = 60_000
    rows = np.empty(count, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("views", object), ("t", "u4")])
    for name in "xyz":
        rows[name] = rng.random(count)
    rows["t"] = np.arange(count)
    # The first rows are alike: the fast path must hand over in the middle.
    lengths = np.where(np.arange(count) < 30_000, 3, rng.integers(0, 12, count))
    lengths[40_000] = 400_000
    for row, length in enumerate(lengths):
        rows["views"][row] = np.zeros(length, "i4")
    kinds = {"views": "i4"}, {"views": "u4"}
    element = plyfile.PlyElement.describe(rows, "vertex", val_types=kinds[0], len_types=kinds[1])
    buffer = io.BytesIO()
    plyfile.PlyData([element], byte_order="<").write(buffer)
    cloud = parse(buffer.getvalue())
    np.testing.assert_array_equal(cloud.scalars["t"], rows["t"])
    np.testing.assert_array_equal(cloud.points[:, 2], rows["z"])


@pytest.mark.parametrize("kind", [LITTLE, BIG, TEXT])
def test_vertex_is_not_first(parse: Parse, kind: str) -> None:
    """Cameras, mixed polygons and unknown elements around the vertices are passed over."""
    order = "<" if kind == LITTLE else ">"
    if kind == TEXT:
        body = b"9.5 1\n3 0 1 0\n4 0 1 0 1\n\n0.5 -1.25 2\n3 4.5 -5.75\n1\n"
    else:
        body = struct.pack(order + "dB", 9.5, 1)
        body += struct.pack(order + "B3i", 3, 0, 1, 0) + struct.pack(order + "B4i", 4, 0, 1, 0, 1)
        body += ROWS.astype(order + "f4").tobytes() + struct.pack(order + "i", 1)
    lines = [
        "element camera 1",
        "property double view",
        "property uchar lens",
        "element face 2",
        "property list uchar int vertex_indices",
        "element vertex 2",
        *XYZ,
        "element unknown 1",
        "property int what",
    ]
    cloud = parse(ply(lines, body, kind))
    np.testing.assert_array_equal(cloud.points, ROWS)
    assert len(cloud.notes) == 1
    assert "its 2 faces are dropped" in cloud.notes[0]


def test_comments(parse: Parse) -> None:
    """obj_info, UTF-8, latin-1 and huge comments are passed over."""
    lines = ["comment Höhe über NN 測量", "obj_info CloudCompare", "comment " + "x" * 60_000, ""]
    data = ply([*lines, "element vertex 2", *XYZ], ROWS.tobytes())
    np.testing.assert_array_equal(parse(data).points, ROWS)
    latin = data.replace("Höhe".encode(), "Höhe".encode("latin-1"))
    np.testing.assert_array_equal(parse(latin).points, ROWS)


def test_comment_with_odd_line_separators(parse: Parse) -> None:
    """Characters that Python counts as line ends do not end a header line."""
    data = ply(["comment a\x0b\x0c\x1c\u2028element vertex 9", "element vertex 2", *XYZ], b"")
    assert len(parse(data + ROWS.tobytes())) == 2


@pytest.mark.parametrize(
    ("lines", "dtype", "row", "expected"),
    [
        (["uchar red", "uchar green", "uchar blue"], "u1", [1, 2, 255], [1, 2, 255]),
        (
            ["uchar red", "uchar green", "uchar blue", "uchar alpha"],
            "u1",
            [1, 2, 3, 4],
            [1, 2, 3, 4],
        ),
        (
            ["uchar diffuse_red", "uchar diffuse_green", "uchar diffuse_blue"],
            "u1",
            [9, 8, 7],
            [9, 8, 7],
        ),
        (["uchar r", "uchar g", "uchar b", "uchar a"], "u1", [1, 2, 3, 4], [1, 2, 3, 4]),
        (["ushort red", "ushort green", "ushort blue"], "<u2", [0, 257, 65535], [0, 257, 65535]),
        (["ushort red", "ushort green", "ushort blue"], "<u2", [0, 9, 255], [0, 9, 255]),
        (["float red", "float green", "float blue"], "<f4", [0, 0.5, 1], [0, 128, 255]),
        (["float red", "float green", "float blue"], "<f4", [0, 9, 255], [0, 9, 255]),
        (["float red", "float green", "float blue"], "<f4", [0, 0.5, 1.04], [0, 128, 255]),
        (["float rgb"], "<u4", [0x000A141E], [10, 20, 30]),
        (["uint rgba"], "<u4", [0xFF0A141E], [10, 20, 30]),
        (["double r", "double g", "double b"], "<f8", [np.nan, -1, 0.2], [0, 0, 51]),
    ],
)
def test_colors(
    parse: Parse, lines: list[str], dtype: str, row: list[float], expected: list[int]
) -> None:
    """Colours come out as 8 or 16 bits, whatever their names and types."""
    header = ["element vertex 1", *XYZ, *(f"property {line}" for line in lines)]
    cloud = parse(ply(header, ROWS[0].tobytes() + np.array(row, dtype).tobytes()))
    assert cloud.colors is not None
    assert cloud.colors.tolist() == [expected]
    assert cloud.scalars == {}
    guessed = dtype in ("<u2", "<f4", "<u4") and max(row) not in (1, 65535)
    assert len(cloud.notes) == guessed


@pytest.mark.parametrize("names", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")])
def test_normals(parse: Parse, names: tuple[str, ...]) -> None:
    """Normals are found under both names, and are float32 even where the file has doubles."""
    lines = ["element vertex 1", *XYZ, *(f"property double {name}" for name in names)]
    cloud = parse(ply(lines, ROWS[0].tobytes() + struct.pack("<3d", 0, 0.6, 1e300)))
    assert cloud.normals is not None
    assert cloud.normals.dtype == np.float32
    np.testing.assert_array_equal(cloud.normals, np.array([[0, 0.6, np.inf]], np.float32))


def test_incomplete_sets_are_scalars(parse: Parse) -> None:
    """Two of three normals or colours are no normals or colours, and are kept as scalars."""
    lines = ["element vertex 1", *XYZ, "property float nx", "property uchar red"]
    cloud = parse(ply(lines, ROWS[0].tobytes() + struct.pack("<fB", 0.5, 7)))
    assert cloud.normals is None
    assert cloud.colors is None
    assert {name: each.tolist() for name, each in cloud.scalars.items()} == {
        "nx": [0.5],
        "red": [7],
    }


def test_gaussian_splat(parse: Parse) -> None:
    """Of a splat file positions and normals are taken, and a note says so."""
    names = ["nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_rest_0", "opacity", "scale_0", "rot_0", "id"]
    lines = ["element vertex 1", *XYZ, *(f"property float {name}" for name in names)]
    cloud = parse(ply(lines, np.arange(13, dtype="<f4").tobytes()))
    assert cloud.normals is not None
    assert list(cloud.scalars) == ["id"]
    assert "Gaussian splat" in cloud.notes[0]


def test_no_points(parse: Parse) -> None:
    """A file without points is a cloud without points; whether that will do is decided later."""
    for kind in (LITTLE, TEXT):
        assert len(parse(ply(["element vertex 0", *XYZ], b"", kind))) == 0


def test_trailing_bytes(parse: Parse) -> None:
    """Bytes after the last row are ignored, with a note that counts them."""
    data = ply(["element vertex 2", *XYZ], ROWS.tobytes() + b"12345")
    assert parse(data).notes == ("5 bytes after the last row are ignored.",)
    text = ply(["element vertex 1", *XYZ], b"1 2 3\nnot a number\n", TEXT)
    assert parse(text).notes == ("Text after the last row is ignored.",)


def test_text_oddities(parse: Parse) -> None:
    """Blank lines, tabs, signs, exponents, nan and a missing last line end are understood."""
    body = b"\n  +1.\t.5 -2E-1 \r\n\n nan inf -inf\n1e400 1e-400 7"
    cloud = parse(ply(["element vertex 3", *XYZ], body, TEXT))
    expected = np.array([[1, 0.5, -0.2], [np.nan, np.inf, -np.inf], [np.inf, 0, 7]], np.float32)
    np.testing.assert_array_equal(cloud.points, expected)


def test_position_of_file_is_respected() -> None:
    """Reading starts where the file stands, and leaves it open."""
    file = io.BytesIO(b"junk" + ply(["element vertex 2", *XYZ], ROWS.tobytes()))
    file.seek(4)
    np.testing.assert_array_equal(read(file).points, ROWS)
    assert not file.closed


def test_real_scan(root: Path) -> None:
    """A real range scan with a camera element reads as plyfile reads it."""
    path = root.parent / "shared" / "scans" / "laurana_range_000.ply"
    if not path.exists():
        pytest.skip("the sample scans are not here")
    cloud = read(path)
    vertex = plyfile.PlyData.read(str(path))["vertex"]
    for column, name in zip(cloud.points.T, "xyz", strict=True):
        np.testing.assert_array_equal(column, vertex[name])
    assert {"x", "y", "z"} | set(cloud.scalars) <= {each.name for each in vertex.properties}


@given(data=st.data())
def test_agrees_with_plyfile(data: st.DataObject) -> None:
    """Whatever plyfile writes, our reader reads to the same numbers."""
    kinds = st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"])
    extra = data.draw(st.dictionaries(st.from_regex("[a-z_]{3,8}", fullmatch=True), kinds))
    extra = {f"s_{name}": kind for name, kind in extra.items()}
    types = {**{name: data.draw(st.sampled_from(["f4", "f8"])) for name in "xyz"}, **extra}
    order = data.draw(st.permutations(sorted(types)))
    count = data.draw(st.integers(0, 20))
    seed = data.draw(st.integers(0, 2**32 - 1))
    raw = np.random.default_rng(seed).integers(-(2**31), 2**31, (count, len(types)))
    rows = np.empty(count, [(name, types[name]) for name in order])
    for name, column in zip(order, raw.T, strict=True):
        rows[name] = column.astype(types[name])
    element = plyfile.PlyElement.describe(rows, "vertex", comments=["made by a test"])
    text, byte_order = data.draw(st.sampled_from([(True, "="), (False, "<"), (False, ">")]))
    buffer = io.BytesIO()
    plyfile.PlyData([element], text=text, byte_order=byte_order).write(buffer)
    buffer.seek(0)
    cloud = read(buffer)
    for index, name in enumerate("xyz"):
        np.testing.assert_array_equal(cloud.points[:, index], rows[name])
    assert set(cloud.scalars) == set(extra)
    for name, values in cloud.scalars.items():
        assert values.dtype == rows[name].dtype
        # plyfile prints text with %.18g: exact.
        np.testing.assert_array_equal(values, rows[name])
