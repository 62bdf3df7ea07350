# SPDX-License-Identifier: Apache-2.0
"""LAS and LAZ, compared with laspy, and what lying headers cost."""

import io
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pugeo_model import Cloud, LimitExceededError, MalformedFileError
from pugeo_model.errors import UntreatableCloudError
from pugeo_model.formats import read

Parse = Callable[..., Cloud]
Dump = Callable[[Cloud, str], bytes]
FORMATS = [("1.2", kind) for kind in range(4)] + [("1.4", kind) for kind in (6, 7, 8)]


def made(version: str = "1.4", kind: int = 7, rows: int = 40, *, compress: bool = False) -> bytes:
    """A file of laspy in which every field has values."""
    rng = np.random.default_rng(kind)
    header = laspy.LasHeader(version=version, point_format=kind)
    header.scales, header.offsets = np.full(3, 0.001), np.array([5e5, 4e6, 0.0])
    header.add_extra_dims(
        [laspy.ExtraBytesParams("height", "f4"), laspy.ExtraBytesParams("tree", "u2")]
    )
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", b'PROJCS["made"]\0'))
    header.system_identifier = "made by a test"
    las = laspy.LasData(header)
    las.x, las.y, las.z = rng.normal(size=(3, rows)) + [[5e5], [4e6], [7.0]]
    for name in header.point_format.dimension_names:
        if name in ("X", "Y", "Z"):
            continue
        dimension = header.point_format.dimension_by_name(name)
        low, high = max(dimension.min, 0), min(dimension.max, 1000)
        values = rng.integers(1, max(high, 1) + 1, rows)
        las[name] = values if name != "height" else rng.random(rows)
        assert low >= 0
    buffer = io.BytesIO()
    las.write(buffer, do_compress=compress)
    return buffer.getvalue()


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize(("version", "kind"), FORMATS)
def test_reads_as_laspy(parse: Parse, version: str, kind: int, compress: bool) -> None:
    """Every field of every point format, extra dimensions included, has laspy's values."""
    data = made(version, kind, compress=compress)
    cloud, las = parse(data), laspy.read(io.BytesIO(data))
    np.testing.assert_array_equal(cloud.points, np.asarray(las.xyz))
    channels = ("red", "green", "blue")
    fields = [n for n in las.point_format.dimension_names if n not in ("X", "Y", "Z", *channels)]
    assert set(cloud.scalars) == set(fields)
    for name in fields:
        np.testing.assert_array_equal(cloud.scalars[name], np.asarray(las[name]))
    if "red" in las.point_format.dimension_names:
        assert cloud.colors is not None
        assert cloud.colors.dtype == np.uint16
        expected = np.stack([np.asarray(las[name]) for name in channels], axis=1)
        np.testing.assert_array_equal(cloud.colors, expected)
    assert cloud.source is not None
    assert cloud.source.crs == 'PROJCS["made"]'


@pytest.mark.parametrize("name", ["las", "laz"])
@pytest.mark.parametrize(("version", "kind"), FORMATS)
def test_round_trip(parse: Parse, dump: Dump, version: str, kind: int, name: str) -> None:
    """A file that is read and written again has the same fields, header and records."""
    data = made(version, kind)
    old = laspy.read(io.BytesIO(data))
    new = laspy.read(io.BytesIO(dump(parse(data), name)))
    for field in old.point_format.dimension_names:
        np.testing.assert_array_equal(np.asarray(new[field]), np.asarray(old[field]), field)
        old_type = old.point_format.dimension_by_name(field).dtype
        assert new.point_format.dimension_by_name(field).dtype == old_type
    assert new.header.point_format.id == old.header.point_format.id
    assert str(new.header.version) == str(old.header.version)
    assert new.header.system_identifier == old.header.system_identifier
    assert (new.header.scales == old.header.scales).all()
    assert (new.header.offsets == old.header.offsets).all()
    records = [record.record_data_bytes() for record in new.header.vlrs]
    assert b'PROJCS["made"]\0' in records


@pytest.mark.parametrize("name", ["las", "laz"])
def test_new_points_and_normals(parse: Parse, dump: Dump, name: str) -> None:
    """Points off the input's grid keep 1e-6, and normals travel as extra dimensions."""
    cloud = parse(made())
    rng = np.random.default_rng(0)
    moved = cloud.points + rng.uniform(0, 1e-3, cloud.points.shape)
    normals = rng.normal(size=moved.shape).astype(np.float32)
    dense = Cloud(moved, normals, cloud.colors, cloud.scalars, source=cloud.source)
    data = dump(dense, name)
    back = parse(data)
    np.testing.assert_allclose(back.points, moved, rtol=0, atol=6e-7)
    np.testing.assert_array_equal(back.normals, normals)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    assert "NormalX" in laspy.read(io.BytesIO(data)).point_format.dimension_names
    assert dump(dense, name) == data


def test_signalling_nan(parse: Parse) -> None:
    """Times that are signalling NaN, as in damaged files, cause no warning of numpy."""
    las = laspy.read(io.BytesIO(made()))
    las.gps_time = np.full(len(las.x), 0x7FF0_0000_0000_0001, np.uint64).view(np.float64)
    file = io.BytesIO()
    las.write(file)
    assert np.isnan(parse(file.getvalue()).scalars["gps_time"]).all()


def test_cloud_of_another_format(parse: Parse, dump: Dump) -> None:
    """Scalars of a PLY file go to the standard fields of their names where these can hold them."""
    rng = np.random.default_rng(1)
    scalars = {
        "scalar_Classification": np.array([2.0, 6, 5], np.float32),
        "Intensity": np.array([1, 2, 70_000]),
        "gps_time": rng.random(3) * 1e9,
        "mask": np.array([True, False, True]),
        "half": np.array([0.5, 1, 2], np.float16),
        "x" * 60: np.array([1, 2, 3], np.int64),
    }
    colors = np.array([[0, 9, 255]] * 3, np.uint8)
    cloud = Cloud(rng.random((3, 3)) * 1e7, colors=colors, scalars=scalars)
    las = laspy.read(io.BytesIO(dump(cloud, "las")))
    assert (las.header.point_format.id, str(las.header.version)) == (7, "1.4")
    assert las.header.global_encoding.wkt
    assert np.asarray(las.classification).tolist() == [2, 6, 5]
    np.testing.assert_array_equal(np.asarray(las.gps_time), scalars["gps_time"])
    assert np.asarray(las["scalar_Intensity"]).tolist() == [1, 2, 70_000]
    assert np.asarray(las.blue).tolist() == [65535] * 3
    back = parse(dump(cloud, "las"))
    np.testing.assert_array_equal(back.colors, colors)
    # Wider than 4 km: the step is the next power of ten.
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=5e-3)


def test_colors_of_8_bits(parse: Parse, dump: Dump) -> None:
    """Colours of 8 bits in 16-bit fields are read as such, with a note, and written back so."""
    header = laspy.LasHeader(version="1.2", point_format=2)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(3.0)
    las.red = las.green = las.blue = np.array([0, 9, 255], np.uint16)
    buffer = io.BytesIO()
    las.write(buffer)
    cloud = parse(buffer.getvalue())
    assert cloud.colors is not None
    assert cloud.colors.dtype == np.uint8
    assert "read as 8 bits" in cloud.notes[0]
    again = laspy.read(io.BytesIO(dump(cloud, "las")))
    assert np.asarray(again.red).tolist() == [0, 9, 255]


def test_header_travels_between_processes(parse: Parse) -> None:
    """Facts about the file can be pickled, as workers of the service need."""
    source = parse(made()).source
    assert source is not None
    assert pickle.loads(pickle.dumps(source)).header == source.header  # noqa: S301 - our own


def test_not_at_the_beginning_of_the_file() -> None:
    """A cloud that begins within a file is read, though its offsets count from its own start."""
    file = io.BytesIO(b"before" + made())
    file.seek(6)
    assert len(read(file)) == 40


def test_points_that_are_not_finite(dump: Dump) -> None:
    """LAS has no missing coordinate, and says so."""
    with pytest.raises(UntreatableCloudError, match="not finite"):
        dump(Cloud(np.array([[np.nan, 0, 0]])), "las")


def _with(data: bytes, offset: int, packed: bytes) -> bytes:
    return data[:offset] + packed + data[offset + len(packed) :]


@pytest.mark.parametrize(
    ("offset", "packed", "match"),
    [
        (0, b"LASX", "LASF|no known format"),
        (25, b"\x07", "version 1.7"),
        (94, struct.pack("<H", 5000), "ends too early"),
        (96, struct.pack("<I", 1 << 30), "ends too early"),
        (100, struct.pack("<I", 0xFFFFFFFF), "records cannot lie"),
        (104, b"\x1f", "point format 31"),
        (105, struct.pack("<H", 3), "3 bytes a point"),
        (243, struct.pack("<I", 9), "extended records"),
        (247, struct.pack("<Q", 41), "ends too early"),
    ],
)
def test_lying_headers(offset: int, packed: bytes, match: str) -> None:
    """A number that cannot be is refused before anything is allocated for it."""
    data = _with(made(), offset, packed)
    with pytest.raises((MalformedFileError, LimitExceededError), match=match):
        read(io.BytesIO(data), format="las")


def test_limits(parse: Parse) -> None:
    """Points, and the bytes that compressed points unpack to, are bounded."""
    for compress in (False, True):
        data = made(compress=compress)
        assert len(parse(data, max_points=40)) == 40
        with pytest.raises(LimitExceededError, match="Points of the LAS file"):
            parse(data, max_points=39)
    with pytest.raises(LimitExceededError, match="unpack to"):
        parse(_with(made(compress=True), 247, struct.pack("<Q", 1000)), max_bytes=20_000)


@pytest.mark.parametrize("kind", [3, 7])
def test_broken_compressed_data(parse: Parse, kind: int) -> None:
    """Truncated LAZ, a wrong table of chunks and layers beyond the file are refused."""
    data = made("1.4" if kind == 7 else "1.2", kind, compress=True)
    (start,) = struct.unpack_from("<I", data, 96)
    (place,) = struct.unpack_from("<q", data, start)
    broken = [data[:-20], data[: start + 40], _with(data, place + 4, struct.pack("<I", 7))]
    broken += [_with(data, place + 4, struct.pack("<I", 0)), _with(data, start, b"\xff" * 8)]
    broken.append(data.replace(b"laszip encoded", b"laszip_encoded"))
    if kind == 7:
        (row,) = struct.unpack_from("<H", data, 105)
        broken.append(_with(data, start + 8 + row + 4, struct.pack("<I", 0xFFFFFFF0)))
    for each in broken:
        with pytest.raises(MalformedFileError):
            parse(each)


@pytest.mark.parametrize("name", ["las", "laz"])
def test_real_scan(root: Path, dump: Dump, name: str) -> None:
    """An airborne scan keeps every field, record, scale and offset when written again."""
    path = root.parent / "shared" / "scans" / "autzen_trim.las"
    if not path.exists():
        pytest.skip("the sample scans are not here")
    old: Any = laspy.read(path)
    new = laspy.read(io.BytesIO(dump(read(path), name)))
    for field in old.point_format.dimension_names:
        np.testing.assert_array_equal(np.asarray(new[field]), np.asarray(old[field]), field)
    np.testing.assert_array_equal(np.asarray(new.xyz), np.asarray(old.xyz))
    records = [(r.user_id, r.record_id, r.record_data_bytes()) for r in old.header.vlrs]
    assert [(r.user_id, r.record_id, r.record_data_bytes()) for r in new.header.vlrs][
        : len(records)
    ] == records
