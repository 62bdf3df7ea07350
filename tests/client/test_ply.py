# SPDX-License-Identifier: Apache-2.0
import io
from collections.abc import Callable

import numpy as np
import plyfile
import pytest

from pugeo_client._ply import read_header, read_ply
from pugeo_client.errors import InvalidResponseError


def test_columns_agree_with_another_reader(ply_bytes: bytes) -> None:
    """Every property comes out with the name, type and values that plyfile reads."""
    ours = read_ply(ply_bytes)
    theirs = plyfile.PlyData.read(io.BytesIO(ply_bytes))["vertex"].data
    assert tuple(ours) == theirs.dtype.names
    for name, column in ours.items():
        assert column.dtype == theirs[name].dtype
        np.testing.assert_array_equal(column, theirs[name])


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("char", "i1"), ("uchar", "u1"), ("short", "i2"), ("ushort", "u2"), ("int", "i4"),
        ("uint", "u4"), ("float", "f4"), ("double", "f8"), ("int8", "i1"), ("uint8", "u1"),
        ("int16", "i2"), ("uint16", "u2"), ("int32", "i4"), ("uint32", "u4"), ("float32", "f4"),
        ("float64", "f8"), ("int64", "i8"), ("uint64", "u8"),
    ],
)  # fmt: skip
def test_every_scalar_type(kind: str, dtype: str) -> None:
    """Both spellings of each scalar type are read as that type."""
    values = np.array([1, 2, 100], dtype=f"<{dtype}")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty {kind} v\n"
    column = read_ply(header.encode() + b"end_header\n" + values.tobytes())["v"]
    assert column.dtype == values.dtype
    np.testing.assert_array_equal(column, values)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:0],
        lambda data: data[:20],
        lambda data: data[:-1],
        lambda data: data + b"x",
        lambda data: data.replace(b"binary_little_endian", b"binary_big_endian"),
        lambda data: data.replace(b"vertex 3", b"vertex many"),
        lambda data: data.replace(b"vertex 3", b"vertex -3"),
        lambda data: data.replace(b"element vertex 3", b"element vertex"),
        lambda data: data.replace(b"element vertex 3", b"element face 3"),
        lambda data: data.replace(b"double x", b"triple x"),
        lambda data: data.replace(b"double x", b"list uchar int x"),
        lambda data: data.replace(b"double y", b"double x"),
        lambda data: data.replace(b"end_header", b"element face 0\nend_header"),
        lambda data: b"<html>" + data,
    ],
)
def test_damaged_files(ply_bytes: bytes, damage: Callable[[bytes], bytes]) -> None:
    """Every kind of damage is InvalidResponseError."""
    with pytest.raises(InvalidResponseError):
        read_ply(damage(ply_bytes))


def test_names_beyond_ascii(ply_bytes: bytes) -> None:
    """Names of properties are UTF-8, as the service writes them, or Latin-1."""
    for encoding in ("utf-8", "latin-1"):
        named = ply_bytes.replace(b"float intensity", "float höhe".encode(encoding))
        assert "höhe" in read_ply(named)
    assert "日本" in read_ply(ply_bytes.replace(b"float intensity", "float 日本".encode()))


def test_text_is_not_read(ply_bytes: bytes) -> None:
    """A PLY in ASCII is told by its header; its arrays are not read."""
    text = ply_bytes.replace(b"binary_little_endian", b"ascii")
    assert read_header(text).ascii
    with pytest.raises(InvalidResponseError, match="ASCII"):
        read_ply(text)
