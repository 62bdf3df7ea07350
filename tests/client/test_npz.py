# SPDX-License-Identifier: Apache-2.0
import io
import struct
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pugeo_client import Meta, Result
from pugeo_client._npz import npy_shape, npz_shapes, read_npy, read_npz, write_npz
from pugeo_client.errors import InvalidResponseError

ARRAYS: dict[str, Any] = {
    "points": np.arange(12, dtype=np.float64).reshape(4, 3),
    "höhe": np.arange(4, dtype=np.float32),
    "file": np.arange(4),
    "allow_pickle": np.array([True, False, True, False]),
    "fortran": np.asfortranarray(np.arange(8).reshape(4, 2)),
}


def archive() -> bytes:
    file = io.BytesIO()
    write_npz(file, ARRAYS)
    return file.getvalue()


def npy(descr: str = "'<f8'", shape: str = "(2, 3)", body: bytes = b"\0" * 48) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


def test_numpy_reads_the_same() -> None:
    """Every array is written as numpy reads it, whatever its name, and read back."""
    theirs = np.load(io.BytesIO(archive()))
    for arrays in (theirs, read_npz(archive())):
        assert set(arrays) == set(ARRAYS)
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(arrays[name], array)
            assert arrays[name].dtype == array.dtype
    assert npz_shapes(io.BytesIO(archive())) == {name: a.shape for name, a in ARRAYS.items()}
    np.testing.assert_array_equal(read_npy(npy()), np.zeros((2, 3)))
    assert npy_shape(io.BytesIO(npy())) == (2, 3)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"<html>",
        npy()[:-1],
        npy() + b"x",
        npy(shape="(-2, 3)"),
        npy(shape="(10**30, 3)"),
        npy(shape="('a',)"),
        npy(shape="(" * 3000 + ")" * 3000),
        npy(descr="'|O'"),
        npy(descr="'nonsense'"),
        npy(descr="[('x', '<f8')]"),
        npy()[:6] + b"\x07\x00" + npy()[8:],
        b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + b" " * 100,
    ],
)
def test_damaged_arrays(data: bytes) -> None:
    """A broken, cut or lying array is InvalidResponseError."""
    with pytest.raises(InvalidResponseError):
        read_npy(data)
    with pytest.raises(InvalidResponseError):
        Result(Meta(), format="npy", data=data).points  # noqa: B018 - raises


def test_a_long_header_is_not_read() -> None:
    """A header that claims 2 GB costs no more than its first kilobytes."""

    class Counting(io.BytesIO):
        most = 0

        def read(self, size: int | None = -1, /) -> bytes:
            data = super().read(size)
            Counting.most = max(Counting.most, len(data))
            return data

    file = Counting(b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + b" " * 1_000_000)
    with pytest.raises(InvalidResponseError):
        npy_shape(file)
    assert Counting.most <= 1 << 14


def test_compressed_members_are_not_unpacked() -> None:
    """An archive of 100 kB that unpacks to 100 MB is refused by its directory."""
    file = io.BytesIO()
    np.savez_compressed(file, points=np.zeros((4_000_000, 3)))
    assert len(file.getvalue()) < 200_000
    with pytest.raises(InvalidResponseError, match="compressed"):
        read_npz(file.getvalue())


def test_encrypted_and_wrong_archives() -> None:
    """An encrypted member, a wrong checksum and an unknown method are InvalidResponseError."""
    data = archive()
    start = data.index(b"PK\x01\x02")
    damages: list[tuple[int, Any]] = [(start + 8, 1), (start + 10, 99), (start + 16, 0)]
    for place, value in damages:
        damaged = bytearray(data)
        damaged[place] = value if value != 0 else damaged[place] ^ 0xFF
        with pytest.raises(InvalidResponseError):
            read_npz(bytes(damaged))
    with pytest.raises(InvalidResponseError):
        Result(Meta(), format="npz", data=zipfile_without_points()).points  # noqa: B018


def zipfile_without_points() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as empty:
        empty.writestr("normals.npy", npy())
    return file.getvalue()


@given(st.data())
def test_random_damage(data: st.DataObject) -> None:
    """Any bytes changed or cut give the arrays or InvalidResponseError, and nothing else."""
    damaged = bytearray(archive())
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(damaged)))
    for candidate in (bytes(damaged), bytes(damaged[:cut])):
        try:
            read_npz(candidate)
        except InvalidResponseError:
            continue
