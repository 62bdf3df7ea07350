# SPDX-License-Identifier: Apache-2.0
"""Checks of a LAS header before the library reads the file, and facts kept for writing back."""

import struct
from dataclasses import dataclass
from typing import IO, Any

from pugeo_model.errors import MalformedFileError, UnsupportedFormatError
from pugeo_model.formats.las.chunks import check_chunks
from pugeo_model.formats.limits import Declared, Limits

__all__ = ["LasInfo", "check", "import_laspy"]

_FIXED = struct.Struct("<4s20xBB68xHIIBHI")
_WIDE_COUNT = 247  # byte of the 64-bit count of points, from version 1.4 on
_WIDE_SIZE = 375  # bytes of that header
_EVLRS = 235  # byte of the offset and number of extended records, which follow the points
_VLR_BYTES, _EVLR_BYTES = 54, 60
_FORMATS = 11


@dataclass(frozen=True)
class LasInfo:
    """Parts of a LAS header that the writer takes over.

    Attributes:
        version: such as ``"1.2"``.
        point_format: 0 to 10.
        scales, offsets: three numbers each.
        vlrs: variable length records (user, record, description, data) apart from those that the
            library writes itself.
        global_encoding, file_source_id: as in the file.
        uuid: 16 bytes.
        system_identifier: as in the file.
        created: day of creation as an ordinal, or ``None``.
        narrow_colors: whether colours of 8 bits stand in its 16-bit fields.
    """

    version: str
    point_format: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    vlrs: tuple[tuple[str, int, str, bytes], ...]
    global_encoding: int
    file_source_id: int
    uuid: bytes
    system_identifier: str
    created: int | None
    narrow_colors: bool = False


def import_laspy() -> Any:
    """Import the library that reads and writes LAS.

    Raises:
        UnsupportedFormatError: it is not installed.
    """
    try:
        import laspy
        import lazrs  # noqa: F401 - laspy takes it for LAZ, and says so late where it is missing
    except ImportError as missing:
        raise UnsupportedFormatError(
            "LAS and LAZ need the packages laspy and lazrs: pip install 'laspy[lazrs]'.",
            code="missing_package",
        ) from missing
    return laspy


def check(file: IO[bytes], size: int, limits: Limits) -> Declared:
    """Compare the numbers of a header with the size of the file and the limits; return them.

    The library trusts them: it would loop over four billion records, or allocate for them.

    Args:
        file: at byte 0 of the file. Left there.
        size: bytes of the file.
        limits: ``max_points``, and ``max_bytes`` for the points as they unpack.

    Raises:
        MalformedFileError: not LAS, or numbers that cannot be.
        LimitExceededError: more points or bytes than ``limits``.
    """
    head = file.read(_WIDE_SIZE)
    file.seek(0)
    if len(head) < _FIXED.size or head[:4] != b"LASF":
        raise MalformedFileError(
            "The file does not begin with a LAS header ('LASF').", code="no_header"
        )
    _, major, minor, length, start, records, kind, row, count = _FIXED.unpack_from(head)
    if (major, minor) not in ((1, 0), (1, 1), (1, 2), (1, 3), (1, 4)):
        raise _bad(f"version {major}.{minor} is not one of 1.0 to 1.4")
    if minor == 4:
        if len(head) < _WIDE_SIZE:
            raise _truncated(_WIDE_SIZE, size)
        (count,) = struct.unpack_from("<Q", head, _WIDE_COUNT)
        first, extended = struct.unpack_from("<QI", head, _EVLRS)
        if extended and not start <= first <= size - extended * _EVLR_BYTES:
            raise _bad(f"{extended:,} extended records lie outside of the file")
    limits.check("max_points", count, "Points of the LAS file")
    if kind & 0x3F >= _FORMATS or row < 20:
        raise _bad(f"point format {kind & 0x3F} with {row} bytes a point is unknown")
    if not 227 <= length <= start <= size:
        raise _truncated(start, size)
    if records * _VLR_BYTES > start - length:
        raise _bad(f"{records:,} records cannot lie between header and points")
    limits.check("max_bytes", count * row, "Bytes that the points unpack to")
    if kind < 128:
        if start + count * row > size:
            raise _truncated(start + count * row, size, count)
    else:
        check_chunks(file, (length, records, start), size, count)
        file.seek(0)
    return Declared(count, row)


def _truncated(expected: int, found: int, count: int = 0) -> MalformedFileError:
    return MalformedFileError(
        f"The LAS file ends too early: its header points to byte {expected:,}, found {found:,}.",
        code="truncated",
        expected_bytes=expected,
        found_bytes=found,
        expected_rows=count,
    )


def _bad(problem: str) -> MalformedFileError:
    return MalformedFileError(f"LAS header: {problem}.", code="bad_header")
