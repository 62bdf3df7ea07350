# SPDX-License-Identifier: Apache-2.0
"""Reader and writer of NPZ, and reader of NPY, in memory bounded by the size of the file.

``numpy.load`` would unpack compressed members of any size and read headers of any length.
"""

import io
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from pugeo_client.errors import InvalidResponseError

__all__ = ["npy_shape", "npz_shapes", "read_npy", "read_npz", "write_npz"]

_MAX_HEADER_BYTES = 1 << 14
_SUFFIX = ".npy"
# Raised by zipfile, zlib and numpy for damaged files.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, ValueError, KeyError,
    TypeError, EOFError, OSError, RuntimeError, SyntaxError, MemoryError, OverflowError,
)  # fmt: skip


@dataclass(frozen=True)
class _Layout:
    """Header of an array: its type, its shape, and where its values begin."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    order: Literal["C", "F"]
    start: int

    @property
    def end(self) -> int:
        return self.start + math.prod(self.shape) * self.dtype.itemsize


def npy_shape(file: BinaryIO) -> tuple[int, ...]:
    """Return the shape of the array in a complete NPY file.

    Raises:
        InvalidResponseError: it is none, or has more or fewer bytes than its header promises.
    """
    with _damage_as_error("NPY"):
        return _layout(file, file.seek(0, os.SEEK_END)).shape


def npz_shapes(file: BinaryIO) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array in a complete NPZ file; the values are not read.

    Raises:
        InvalidResponseError: it is none, or an array is compressed or cut.
    """
    with _damage_as_error("NPZ"), zipfile.ZipFile(file) as archive:
        return {name: layout.shape for name, _, layout in _members(archive)}


def read_npy(data: bytes) -> NDArray[Any]:
    """Read the array of an NPY file.

    Raises:
        InvalidResponseError: as `npy_shape`.
    """
    with _damage_as_error("NPY"):
        file = io.BytesIO(data)
        return _values(file, _layout(file, len(data)))


def read_npz(data: bytes) -> dict[str, NDArray[Any]]:
    """Read all arrays of an NPZ file by name.

    Raises:
        InvalidResponseError: as `npz_shapes`, or a checksum is wrong.
    """
    arrays = {}
    with _damage_as_error("NPZ"), zipfile.ZipFile(io.BytesIO(data)) as archive:
        for name, member, layout in _members(archive):
            with archive.open(member) as file:
                arrays[name] = _values(file, layout)
    return arrays


def write_npz(file: BinaryIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name, uncompressed.

    ``numpy.savez`` takes names as its own arguments, so that no array can be called ``file``.
    """
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(name + _SUFFIX, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


def _members(archive: zipfile.ZipFile) -> Iterator[tuple[str, zipfile.ZipInfo, _Layout]]:
    for member in archive.infolist():
        if member.compress_type != zipfile.ZIP_STORED or member.compress_size != member.file_size:
            raise ValueError(f"{member.filename} is compressed")
        with archive.open(member) as file:
            layout = _layout(file, member.file_size)
        yield member.filename.removesuffix(_SUFFIX), member, layout


def _layout(file: IO[bytes], size: int) -> _Layout:
    """Parse the header of an array of ``size`` bytes, header included."""
    file.seek(0)
    beginning = io.BytesIO(file.read(_MAX_HEADER_BYTES))
    version = np.lib.format.read_magic(beginning)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, fortran, dtype = read(beginning)
    layout = _Layout(shape, dtype, "F" if fortran else "C", beginning.tell())
    if dtype.kind not in "fiub" or any(length < 0 for length in shape):
        raise ValueError(f"it has an array of type {dtype} and shape {shape}")
    if layout.end != size:
        raise ValueError(f"its header promises {layout.end} bytes, and there are {size}")
    return layout


def _values(file: IO[bytes], layout: _Layout) -> NDArray[Any]:
    file.seek(layout.start)
    values = np.frombuffer(bytearray(file.read()), dtype=layout.dtype)  # bytearray: writable
    return values.reshape(layout.shape, order=layout.order)


@contextmanager
def _damage_as_error(kind: str) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        raise InvalidResponseError(f"the answer is no complete {kind}: {error}") from error
