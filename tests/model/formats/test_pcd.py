# SPDX-License-Identifier: Apache-2.0
"""PCD in its three encodings, compared with pypcd4."""

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError
from pugeo_model.formats import lzf, read

pypcd4: Any = pytest.importorskip("pypcd4")

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]
ENCODINGS = [pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY, pypcd4.Encoding.BINARY_COMPRESSED]
HEAD = (
    "# .PCD v.7\nVERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n"
)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_reads_pypcd4(parse: Parse, encoding: Any, tmp_path: Path) -> None:
    """All encodings of pypcd4 read the same: points, packed colours, normals, scalars."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (500, 3)).astype(np.uint8)
    normals = rng.normal(size=(500, 3)).astype(np.float32)
    label = rng.integers(0, 9, 500).astype(np.uint16)
    fields = ("x", "y", "z", "rgb", "normal_x", "normal_y", "normal_z", "label", "t")
    types = (*[np.float32] * 7, np.uint16, np.float64)
    times = rng.random(500) * 1e9
    packed = pypcd4.PointCloud.encode_rgb(colors)
    columns = [*points.T, packed, *normals.T, label, times]
    path = tmp_path / "made.pcd"
    pypcd4.PointCloud.from_points(columns, fields, types).save(path, encoding=encoding)
    cloud = parse(path.read_bytes())
    digits = 1e-5 if encoding is pypcd4.Encoding.ASCII else 0
    assert cloud.normals is not None
    np.testing.assert_allclose(cloud.points, points, atol=digits)
    assert cloud.points.dtype == np.float32
    np.testing.assert_allclose(cloud.normals, normals, atol=digits)
    np.testing.assert_array_equal(cloud.scalars["label"], label)
    np.testing.assert_allclose(cloud.scalars["t"], times, rtol=1e-5 if digits else 0)
    if encoding is not pypcd4.Encoding.ASCII:
        # pypcd4 prints packed colours with fewer digits than they need.
        np.testing.assert_array_equal(cloud.colors, colors)


def test_pypcd4_reads_ours(rich: Cloud, dump: Dump) -> None:
    """Our file has the names and types of PCL, and the same values."""
    frame = pypcd4.PointCloud.from_fileobj(io.BytesIO(dump(rich, "pcd")))
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb")
    assert frame.fields[:7] == names
    np.testing.assert_array_equal(frame.numpy(("x", "y", "z")), rich.points)
    np.testing.assert_array_equal(frame.numpy(names[3:6]), rich.normals)
    assert rich.colors is not None
    decoded = pypcd4.PointCloud.decode_rgb(frame.pc_data["rgb"])
    np.testing.assert_array_equal(decoded, rich.colors[:, :3])
    for name, values in rich.scalars.items():
        np.testing.assert_array_equal(frame.pc_data[name], values)


def test_viewpoint(parse: Parse, dump: Dump) -> None:
    """VIEWPOINT is the sensor, kept when written; the default is one in an image only."""
    text = HEAD + "1 2 3\n4 5 6\n"
    assert parse(text.encode()).viewpoints is None
    cloud = parse(text.replace("VIEWPOINT 0 0 0", "VIEWPOINT 5.5 4e6 1").encode())
    assert cloud.viewpoints is not None
    assert cloud.viewpoints.tolist() == [[5.5, 4e6, 1]]
    again = parse(dump(cloud, "pcd"))
    np.testing.assert_array_equal(again.viewpoints, cloud.viewpoints)
    image = parse(text.replace("WIDTH 2\nHEIGHT 1", "WIDTH 1\nHEIGHT 2").encode())
    assert image.viewpoints is not None
    assert image.viewpoints.tolist() == [[0, 0, 0]]


def test_repeated_and_padded_fields(parse: Parse) -> None:
    """A field of several values gives numbered scalars; padding is passed over."""
    head = HEAD.replace("x y z", "x y z _ hist").replace("4 4 4", "4 4 4 1 2")
    head = head.replace("F F F", "F F F U I").replace("1 1 1\n", "1 1 1 3 2\n")
    row = struct.pack("<fff3xhh", 1, 2, 3, 7, -8)
    cloud = parse(head.replace("ascii", "binary").encode() + row * 2)
    assert cloud.points.tolist() == [[1, 2, 3]] * 2
    assert {name: values.tolist() for name, values in cloud.scalars.items()} == {
        "hist_0": [7, 7],
        "hist_1": [-8, -8],
    }


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("DATA ascii\n", "", "no line 'DATA'"),
        ("DATA ascii", "DATA zip", "DATA must be one of"),
        ("FIELDS x y z", "FIELDS x y", "3 whole numbers|2 whole numbers|same number"),
        ("FIELDS x y z", "FIELDS x y y", "declared twice"),
        ("FIELDS x y z", "FIELDS x y w", "no column z"),
        ("SIZE 4 4 4", "SIZE 4 4 3", "unknown type"),
        ("TYPE F F F", "TYPE F F Q", "unknown type"),
        ("COUNT 1 1 1", "COUNT 1 1 9999", "values, at most"),
        ("POINTS 2", "POINTS 3", "WIDTH x HEIGHT"),
        ("POINTS 2", "POINTS two", "whole numbers"),
        ("VIEWPOINT 0 0 0", "VIEWPOINT a 0 0", "seven numbers"),
        ("VIEWPOINT 0 0 0", "VIEWPOINT nan 0 0", "not finite"),
        ("4 5 6\n", "4 5 6 7\n", "Line 13 has not the 3 values"),
        ("4 5 6\n", "", "ends too early"),
        ("4 5 6", "4 5 x", "'x' is not a number"),
    ],
)
def test_broken_files(parse: Parse, old: str, new: str, match: str) -> None:
    """Every line that makes no sense is refused by name."""
    text = HEAD + "1 2 3\n4 5 6\n"
    assert old in text
    with pytest.raises(MalformedFileError, match=match):
        parse(text.replace(old, new).encode())


def test_limits(parse: Parse) -> None:
    """Declared points, header and unpacked bytes are bounded before they are allocated."""
    text = HEAD.replace("WIDTH 2", "WIDTH 4000000000").replace("POINTS 2", "POINTS 4000000000")
    with pytest.raises(LimitExceededError, match="Points of the PCD file"):
        parse(text.encode())
    with pytest.raises(LimitExceededError, match="header"):
        read(io.BytesIO(b"# comment\n" * 9000 + HEAD.encode()), format="pcd")
    head = HEAD.replace("ascii", "binary_compressed")
    large = head.replace("WIDTH 2", "WIDTH 200").replace("POINTS 2", "POINTS 200").encode()
    with pytest.raises(LimitExceededError, match="Bytes of the points with all attributes: 2,400"):
        parse(large + struct.pack("<II", 8, 2400) + bytes(8), max_bytes=1000)
    with pytest.raises(MalformedFileError, match="header declares 24"):
        parse(head.encode() + struct.pack("<II", 8, 99) + bytes(8))


def test_lzf() -> None:
    """Literals and overlapping references unpack; lies about sizes and distances do not."""
    data = bytes([2]) + b"abc" + bytes([0x20, 2]) + bytes([0xE0, 5, 0])
    unpacked = lzf.decompress(data, 3 + 3 + 14)
    assert unpacked is not None
    assert unpacked.tobytes() == b"abcabc" + b"c" * 14
    assert lzf.decompress(data, 19) is None
    assert lzf.decompress(data, 21) is None
    assert lzf.decompress(bytes([0x20, 9]), 3) is None
    assert lzf.decompress(bytes([31, 1]), 32) is None
    assert lzf.decompress(b"\0a", 1 << 40) is None


def test_real_scan(root: Path, dump: Dump) -> None:
    """A Kinect frame reads as pypcd4 reads it, and is the same after writing."""
    path = root.parent / "shared" / "scans" / "office1.pcd"
    if not path.exists():
        pytest.skip("the sample scans are not here")
    cloud, frame = read(path), pypcd4.PointCloud.from_path(path)
    np.testing.assert_array_equal(cloud.points, frame.numpy(("x", "y", "z")))
    np.testing.assert_array_equal(cloud.colors, pypcd4.PointCloud.decode_rgb(frame.pc_data["rgb"]))
    assert cloud.viewpoints is not None
    back = read(io.BytesIO(dump(cloud, "pcd")))
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.colors, cloud.colors)
