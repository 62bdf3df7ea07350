# SPDX-License-Identifier: Apache-2.0
"""NumPy archives (``.npz``), without pickles; reads single arrays (``.npy``) as well."""

import io
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import CloudError, LimitExceededError, MalformedFileError
from pugeo_model.formats.colors import to_channels
from pugeo_model.formats.limits import Declared, Limits, bounded_notes, shortened
from pugeo_model.formats.meaning import from_array
from pugeo_model.formats.stream import bytes_left

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "NPY_MAGIC", "declared", "read", "sniff", "write"]

NAME = "npz"
EXTENSIONS: tuple[str, ...] = (".npz",)
MEDIA_TYPES: tuple[str, ...] = ("application/x-npz",)

NPY_MAGIC = b"\x93NUMPY"
_ZIP = b"PK\x03\x04"
_KNOWN = ("points", "normals", "colors")
_READ_BYTES = 1 << 20
_FEWEST_COLUMNS, _MOST_COLUMNS = 3, 256  # of a single array
_MOST_AXES = 64  # of an array of NumPy
_MOST_EXTENT = (1 << 63) - 1
_SHOWN_CHARACTERS = 60  # of a type or shape, in messages
# NumPy pads a header to so many bytes, if its type has no fields.
_USUAL_HEADER_BYTES = 128
_SHAPE = re.compile(rb"""shape['"]\s*:\s*[(\[]([^)\]]*)""")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Version of the npy format -> bytes of the length of a header, and numpy's parser of it.
_HEADERS: dict[tuple[int, int], tuple[int, Callable[..., Any]]] = {
    (1, 0): (2, npy.read_array_header_1_0),
    (2, 0): (4, npy.read_array_header_2_0),
}


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is an archive."""
    return head.startswith(_ZIP)


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read an archive with ``points``, ``normals``, ``colors`` and scalars, or one array.

    Every other ``(M,)`` numeric array of an archive is a scalar. A single array is ``(M, K)``:
    points, and further columns whose meaning is guessed, see `meaning.guess`. The declared size of
    each array is checked before it is unpacked, so that a small archive cannot unpack to a large
    one.

    Args:
        file: seekable, at the first byte.
        limits: bounds of the file, and of what it unpacks to.

    Raises:
        MalformedFileError: truncated, pickled, of a wrong shape or type.
        LimitExceededError: more points or bytes than ``limits``.
    """
    if not _is_array(file):
        return _read_archive(file, limits)
    with _as_malformed("The array"):
        array = _single_array(file, limits)
        values = array.read(file, bytes_left(file))
    return from_array(values)


def declared(file: IO[bytes], limits: Limits) -> Declared:
    """Return the size of a cloud as the headers of its arrays state it; nothing is unpacked.

    Args:
        file: seekable, at the first byte.
        limits: bounds of headers, points and bytes.

    Raises:
        MalformedFileError, LimitExceededError: as `read`.
    """
    if _is_array(file):
        with _as_malformed("The array"):
            array = _single_array(file, limits)
        return Declared(array.shape[0], array.shape[1] * array.dtype.itemsize)
    _check_directory(file, limits)
    with _as_malformed("The archive"), zipfile.ZipFile(file) as archive:
        contents = _contents(archive, limits)
        return Declared(contents.count, sum(each.row_bytes for each in contents.wanted))


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write an uncompressed archive; the same cloud always gives the same bytes."""
    arrays: dict[str, NDArray[Any]] = {"points": cloud.points}
    if cloud.normals is not None:
        arrays["normals"] = cloud.normals
    if cloud.colors is not None:
        arrays["colors"] = cloud.colors
    for name, values in cloud.scalars.items():
        free = re.sub(r"[\x00-\x1f/\\:]", "_", name)[:200] or "scalar"
        while free in arrays or free in _KNOWN:
            free = f"scalar_{free}"
        arrays[free] = values
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, values in arrays.items():
            # A ZipInfo of its own has a fixed date, where writestr would take today's.
            entry = zipfile.ZipInfo(f"{name}.npy")
            with archive.open(entry, "w", force_zip64=True) as member:
                npy.write_array(member, np.ascontiguousarray(values), allow_pickle=False)


@dataclass(frozen=True)
class _Declared:
    """An array as its header describes it, with the size of that header beyond the usual."""

    name: str
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    beyond_usual: int

    def __str__(self) -> str:
        shown = (shortened(str(each), _SHOWN_CHARACTERS) for each in (self.dtype, self.shape))
        return " ".join(shown)

    @property
    def size(self) -> int:
        """Bytes of its data."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Bytes of one point."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    def read(self, file: IO[bytes], found: int) -> NDArray[Any]:
        """Read the data that follow the header, ``found`` bytes at most."""
        if self.size > found:
            raise self._truncated(found)
        data = np.empty(self.size, np.uint8)
        done = 0
        while done < self.size:
            block = file.read(min(_READ_BYTES, self.size - done))
            if not block:
                raise self._truncated(done)
            data[done : done + len(block)] = np.frombuffer(block, np.uint8)
            done += len(block)
        rows = self.shape[::-1] if self.fortran else self.shape
        values: NDArray[Any] = data.view(self.dtype).reshape(rows)
        # This machine's byte order and row order.
        native = self.dtype.newbyteorder("=")
        return np.ascontiguousarray(values.T if self.fortran else values, native)

    def _truncated(self, found: int) -> MalformedFileError:
        return MalformedFileError(
            f"Array {self.name!r} ({self}) takes {self.size:,} bytes, found {found:,}.",
            code="truncated",
            expected_bytes=self.size,
            found_bytes=found,
        )


@dataclass(frozen=True)
class _Contents:
    """The arrays of an archive as their headers describe them.

    Attributes:
        arrays: all of them by name.
        entries: their places in the archive.
        count: number of points.
        wanted: those that belong to the cloud.
    """

    arrays: dict[str, _Declared]
    entries: dict[str, zipfile.ZipInfo]
    count: int
    wanted: list[_Declared]


def _is_array(file: IO[bytes]) -> bool:
    """Return whether a file is a single array; its position stays."""
    head = file.read(len(NPY_MAGIC))
    file.seek(-len(head), 1)
    return head == NPY_MAGIC


def _single_array(file: IO[bytes], limits: Limits) -> _Declared:
    array = _declared(file, "array", limits)
    shape = array.shape
    wide = len(shape) == 2 and _FEWEST_COLUMNS <= shape[1] <= _MOST_COLUMNS
    if not wide or array.dtype.kind not in "fiu":
        raise _bad(
            f"A single array must be numeric of shape (M, 3), or have up to {_MOST_COLUMNS} "
            f"columns more, not {array}. An npz archive names its columns."
        )
    limits.check("max_points", shape[0], "Points of the array")
    limits.check("max_bytes", array.size, "Bytes of the array")
    return array


def _declared(file: IO[bytes], name: str, limits: Limits, others: int = 0) -> _Declared:
    """Read the header of an array.

    A thousand headers of 10 kB deflate to nothing and take half a minute to parse. So the bytes
    beyond the usual size of each are bounded in total as well.
    ``others`` are those of the arrays before it.
    """
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise _bad(f"Array {name!r} has version {version} of the npy format, not 1.0 or 2.0.")
    width, parse = _HEADERS[version]
    # numpy would read as many bytes as the header claims to have, and a deflated member of some
    # kilobytes unpacks to gigabytes of blanks.
    length = file.read(width)
    claimed = int.from_bytes(length, "little")
    limits.check("max_header_bytes", claimed, f"Bytes of the header of array {name!r}")
    beyond = max(0, claimed - _USUAL_HEADER_BYTES)
    what = f"Bytes of the headers of all arrays beyond {_USUAL_HEADER_BYTES} of each"
    limits.check("max_header_bytes", others + beyond, what)
    header = file.read(claimed)
    found = _SHAPE.search(header)
    if found is not None and found[1].count(b",") > _MOST_AXES:
        raise _bad(f"Array {name!r} has more than the {_MOST_AXES} axes that NumPy allows.")
    shape, fortran, dtype = parse(io.BytesIO(length + header))
    if dtype.hasobject:
        raise _bad(f"Array {name!r} holds Python objects, which are never unpickled.")
    # The pattern does not know each way in which a shape can be written.
    if len(shape) > _MOST_AXES or any(not 0 <= extent <= _MOST_EXTENT for extent in shape):
        raise _bad(f"Array {name!r} has a negative extent, or one that is too large, or many axes.")
    return _Declared(name, shape, fortran, dtype, beyond)


def _contents(archive: zipfile.ZipFile, limits: Limits) -> _Contents:
    """Read the headers of all arrays and check them against the limits."""
    arrays: dict[str, _Declared] = {}
    entries: dict[str, zipfile.ZipInfo] = {}
    beyond = 0
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name in entries:
            raise _bad(f"Array {name!r} is in the archive twice.")
        _check_method(name, entry)
        entries[name] = entry
        with archive.open(entry) as member:
            arrays[name] = _declared(member, name, limits, beyond)
        beyond += arrays[name].beyond_usual
    if "points" not in arrays:
        found = ", ".join(sorted(arrays)[:20]) or "nothing"
        raise _bad(f"The archive has no array 'points' (M, 3); it holds {found}.")
    count = _check_known(arrays)
    limits.check("max_points", count, "Points of the archive")
    wanted = [each for each in arrays.values() if each.name in _KNOWN or _is_scalar(each, count)]
    total = sum(each.size for each in wanted)
    limits.check("max_bytes", total, "Bytes that the archive unpacks to")
    return _Contents(arrays, entries, count, wanted)


def _read_archive(file: IO[bytes], limits: Limits) -> Cloud:
    _check_directory(file, limits)
    with _as_malformed("The archive"), zipfile.ZipFile(file) as archive:
        contents = _contents(archive, limits)
        arrays: dict[str, NDArray[Any]] = {}
        for array in contents.wanted:
            entry = contents.entries[array.name]
            with archive.open(entry) as member:
                again = _declared(member, array.name, limits)
                arrays[array.name] = again.read(member, entry.file_size)

    dropped = contents.arrays.keys() - arrays.keys()
    points = _points(arrays.pop("points"))
    normals = _normals(arrays.pop("normals")) if "normals" in arrays else None
    notes = [
        f"Array {name!r} ({each}) is dropped: a scalar would be numeric of shape "
        f"({contents.count},)."
        for name, each in contents.arrays.items()
        if name in dropped
    ]
    colors: NDArray[Any] | None = None
    if "colors" in arrays:
        colors, note = to_channels(arrays.pop("colors"))
        notes += [note] if note else []
    return Cloud(points, normals, colors, arrays, bounded_notes(notes))


def _check_known(declared: dict[str, _Declared]) -> int:
    """Check the arrays whose meaning is fixed; returns the number of points."""
    shape = declared["points"].shape
    count = shape[0] if shape else 0
    for name, widths in (("points", (3,)), ("normals", (3,)), ("colors", (3, 4))):
        each = declared.get(name)
        if each is None:
            continue
        if each.dtype.kind not in "fiu" or each.shape not in [(count, w) for w in widths]:
            wanted = " or ".join(f"({count}, {width})" for width in widths)
            raise _bad(f"Array {name!r} must be numeric of shape {wanted}, not {each}.")
    return count


def _is_scalar(declared: _Declared, count: int) -> bool:
    return declared.shape == (count,) and declared.dtype.kind in "fiub"


def _points(values: NDArray[Any]) -> NDArray[Any]:
    small = values.dtype.kind == "f" and values.dtype.itemsize <= 4
    return np.ascontiguousarray(values, np.float32 if small else np.float64)


def _normals(values: NDArray[Any]) -> NDArray[np.float32]:
    # A value that float32 cannot hold becomes infinite: cleaning drops it, no warning needed.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, np.float32)


def _check_method(name: str, entry: zipfile.ZipInfo) -> None:
    """Allow the methods that numpy writes.

    LZMA would allocate a dictionary of whatever size a member asks for, and its errors are none
    of those that zipfile promises.
    """
    if entry.compress_type not in _METHODS:
        raise _bad(
            f"Array {name!r} is compressed by method {entry.compress_type}; archives of numpy, "
            "stored or deflated, are read."
        )


def _check_directory(file: IO[bytes], limits: Limits) -> None:
    """Bound the archive's directory, which zipfile would read whatever its size.

    An entry takes at least 46 bytes, so this bounds their number too.
    """
    start, size = file.tell(), bytes_left(file)
    tail_size = min(size, 22 + 65_535)
    file.seek(start + size - tail_size)
    tail = file.read(tail_size)
    file.seek(start)
    end = len(tail) - 22 if tail[-22:-18] == b"PK\x05\x06" else tail.rfind(b"PK\x05\x06")
    if end < 0 or len(tail) < end + 22:
        raise MalformedFileError(
            "The zip archive has no end: it may be truncated.", code="truncated"
        )
    if tail[max(0, end - 20) : end].startswith(b"PK\x06\x07"):
        raise LimitExceededError(
            "Zip archives of more than 4 GiB or 65,535 entries are not read.",
            name="max_bytes",
            limit=min(limits.max_bytes, (1 << 32) - 1),
            value=1 << 32,
        )
    directory = int.from_bytes(tail[end + 12 : end + 16], "little")
    limits.check("max_header_bytes", directory, "Bytes of the zip archive's directory")


@contextmanager
def _as_malformed(name: str) -> Iterator[None]:
    """Turn the errors of numpy, zipfile and zlib about broken bytes into one."""
    try:
        yield
    except CloudError:
        raise
    except (
        ValueError,
        TypeError,
        KeyError,
        EOFError,
        OSError,
        OverflowError,
        MemoryError,
        RuntimeError,
        SyntaxError,
        Warning,
        struct.error,
        tokenize.TokenError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise _bad(f"{name} cannot be read: {error}.") from error


def _bad(message: str) -> MalformedFileError:
    return MalformedFileError(message, code="bad_array")
