# SPDX-License-Identifier: Apache-2.0
"""Reading and writing point clouds.

A new file format is one new module with the names of `Reader`, or of `Format` if it is written too,
entered in ``_MODULES``; if its rows follow each other, also in ``BY_ROWS``.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Protocol, cast

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import MalformedFileError, UnsupportedFormatError
from pugeo_model.formats import (
    e57,
    json_points,
    las,
    laz,
    npy,
    npz,
    obj,
    pcd,
    ply,
    ply_ascii,
    ptx,
    stl,
    xyz,
)
from pugeo_model.formats.limits import DEFAULT_LIMITS, Declared, Limits, bounded_notes
from pugeo_model.formats.stream import Source, Target, replacing, seekable

__all__ = [
    "BY_ROWS",
    "FORMATS",
    "HEAD_BYTES",
    "WRITABLE",
    "ByRows",
    "Declared",
    "Format",
    "Limits",
    "Reader",
    "by_rows",
    "declared",
    "detect",
    "dropped",
    "output_format",
    "read",
    "sniff",
    "write",
    "written_as",
]


class Reader(Protocol):
    """Names that a module must have to be a format that is read.

    A format whose header states the number of points has a function ``declared(file, limits)`` too,
    which returns a `Declared`.

    Attributes:
        NAME: key in ``FORMATS``.
        EXTENSIONS: file name endings in lower case, with the dot.
        MEDIA_TYPES: the first one is what the format is served as.
    """

    NAME: str
    EXTENSIONS: tuple[str, ...]
    MEDIA_TYPES: tuple[str, ...]

    def sniff(self, head: bytes, /) -> bool:
        """True if a file that begins with these bytes is of this format."""

    def read(self, file: IO[bytes], limits: Limits, /) -> Cloud:
        """Read a seekable file from its current position."""


class Format(Reader, Protocol):
    """Names that a module must have to be a format that is read and written.

    A format without room for some attributes has a function ``drops(cloud)`` too, which names
    those of a cloud.
    """

    def write(self, cloud: Cloud, file: IO[bytes], /) -> None:
        """Write a cloud; the file need not be seekable."""


class ByRows(Protocol):
    """Functions of a format whose rows follow each other: it is written part by part."""

    def head(self, cloud: Cloud, count: int, /) -> bytes:
        """Bytes before the rows of ``count`` points with the attributes of ``cloud``."""

    def rows(self, cloud: Cloud, /) -> Iterator[bytes]:
        """The rows of some of the points."""


# Asked in this order: formats that are recognised by less come later.
_MODULES: tuple[Reader, ...] = (
    *(ply_ascii, ply, npz, npy, laz, las, e57, pcd, ptx, json_points, stl, obj, xyz),
)

FORMATS: dict[str, Reader] = {module.NAME: module for module in _MODULES}
"""All formats that are read."""

WRITABLE: dict[str, Format] = {
    name: cast("Format", module) for name, module in FORMATS.items() if hasattr(module, "write")
}
"""The formats among them that are written too."""

BY_ROWS: dict[str, ByRows] = {"ply": ply, "ply-ascii": ply_ascii, "xyz": xyz, "pcd": pcd}

_WITH_VIEWPOINTS = frozenset({"e57", "pcd", "ptx"})
_WITH_CRS = frozenset({"e57", "las", "laz"})

HEAD_BYTES = 4096
"""Leading bytes of a file from which its format is recognised."""


def sniff(head: bytes) -> str | None:
    """Tell the format of a file by its first `HEAD_BYTES` bytes; ``None`` if none recognises it."""
    return next((key for key, module in FORMATS.items() if module.sniff(head)), None)


def detect(file: IO[bytes], *, name: str | None = None) -> str:
    """Tell the format of a file: by its content, else by the extension of its name.

    Args:
        file: seekable; its position stays.
        name: file name, as far as it is known.

    Returns:
        A key of ``FORMATS``.

    Raises:
        UnsupportedFormatError: neither is known.
        MalformedFileError: the file is empty.
    """
    here = file.tell()
    head = file.read(HEAD_BYTES)
    file.seek(here)
    if not head:
        raise MalformedFileError("The file is empty.", code="empty")
    if (found := sniff(head)) is not None:
        return found
    if name is not None and (found := _by_extension(name)) is not None:
        return found
    raise UnsupportedFormatError(
        f"The content is of no known format. Readable are {_described(FORMATS)}.",
        formats=list(FORMATS),
    )


def read(source: Source, *, format: str | None = None, limits: Limits = DEFAULT_LIMITS) -> Cloud:
    """Read a point cloud.

    Args:
        source: path, or binary file at the cloud's first byte (real, spooled, in memory, or a
            pipe; it stays open).
        format: a key of ``FORMATS``; found out from content and name where it is ``None``.
        limits: checked before anything is allocated.

    Returns:
        The cloud as the file has it, nothing cleaned, with notes on what was guessed or dropped.

    Raises:
        MalformedFileError: the bytes break the rules of the format.
        UnsupportedFormatError: no such format, or none recognised.
        LimitExceededError: too large.
        OSError: the path cannot be read.
        TypeError: neither a path nor a file.
    """
    if not isinstance(source, str | os.PathLike) and not hasattr(source, "read"):
        raise TypeError(f"read takes a path or a binary file, not {type(source).__name__}")
    module = None if format is None else _reader(format)
    with seekable(source, limits) as file:
        if module is None:
            name = os.fspath(source) if isinstance(source, str | os.PathLike) else None
            module = FORMATS[detect(file, name=name)]
        # Before the first point: a small compressed file may unpack to more than the memory.
        size = _declared_by(module, file, limits)
        if size is not None:
            size.check(limits)
        cloud = module.read(file, limits)
    info = replace(cloud.source or SourceInfo(module.NAME), format=module.NAME)
    notes = bounded_notes(cloud.notes)
    if module.NAME not in WRITABLE:
        notes += (f"{module.NAME.upper()} is only read: the output is PLY by default.",)
    return replace(cloud, source=info, notes=notes)


def declared(
    source: Source, *, format: str | None = None, limits: Limits = DEFAULT_LIMITS
) -> Declared | None:
    """Return the size of a cloud as the header of its file states it, without reading its points.

    Args:
        source: see `read`.
        format: see `read`.
        limits: checked against the header.

    Returns:
        The size; ``None`` if the header of this format states none (text, JSON, E57, PTX).

    Raises:
        MalformedFileError, UnsupportedFormatError, LimitExceededError, OSError: see `read`.
    """
    module = None if format is None else _reader(format)
    with seekable(source, limits) as file:
        if module is None:
            module = FORMATS[detect(file)]
        size = _declared_by(module, file, limits)
    if size is not None:
        size.check(limits)
    return size


def write(cloud: Cloud, target: Target, *, format: str | None = None) -> None:
    """Write a point cloud.

    Args:
        cloud: points and attributes; its notes are not part of any format.
        target: path, replaced only once the file is complete; or binary file, left open.
        format: a key of ``WRITABLE``; by the path's extension, else ``"ply"``, where ``None``.

    Raises:
        UnsupportedFormatError: no such format, or an extension that belongs to none.
        OSError: the path cannot be written.
        TypeError: no cloud, or neither a path nor a file.
    """
    _refuse_other_kinds(cloud, target)
    if isinstance(target, str | os.PathLike):
        path = os.fspath(target)
        module = _writer(format or written_as(path))
        with replacing(path) as file:
            module.write(cloud, file)
    else:
        _writer(format or "ply").write(cloud, target)


def _refuse_other_kinds(cloud: object, target: object) -> None:
    """Refuse arguments of `write` that are swapped, or of another type."""
    is_target = isinstance(target, str | os.PathLike) or hasattr(target, "write")
    if not isinstance(cloud, Cloud) or not is_target:
        raise TypeError(
            "write takes a Cloud, then a path or a binary file, not "
            f"{type(cloud).__name__} and {type(target).__name__}"
        )


def output_format(read_as: str | None) -> str:
    """Choose the format of an answer to an input: its own, or PLY where that cannot be written.

    Args:
        read_as: a key of ``FORMATS``, such as ``cloud.source.format``; ``None`` for a cloud that
            comes from no file.
    """
    return read_as if read_as in WRITABLE else "ply"


def dropped(cloud: Cloud, format: str) -> str | None:
    """A note that names the attributes of a cloud that a format has no room for, if there are any.

    Args:
        cloud: the cloud to be written.
        format: a key of ``WRITABLE``.
    """
    module = WRITABLE[format]
    names: list[str] = module.drops(cloud) if hasattr(module, "drops") else []
    if cloud.viewpoints is not None and format not in _WITH_VIEWPOINTS:
        names.append("viewpoints")
    if cloud.source is not None and cloud.source.crs and format not in _WITH_CRS:
        names.append("the coordinate reference system")
    return f"Not written, since {format} has no room for it: {', '.join(names)}." if names else None


def by_rows(cloud: Cloud, format: str) -> bool:
    """True if clouds like this one can be written part by part, by the format in ``BY_ROWS``.

    Scalars of 64-bit integers are stored in a type that holds all values, which no part knows.
    """
    wide = any(v.dtype.kind in "iu" and v.dtype.itemsize == 8 for v in cloud.scalars.values())
    return format in BY_ROWS and not wide


def written_as(path: str | os.PathLike[str]) -> str:
    """The format that `write` takes for a path: by its extension, ``"ply"`` without one.

    Raises:
        UnsupportedFormatError: an extension that belongs to no format that is written.
    """
    name = os.fspath(path)
    key = _by_extension(name)
    if (key is None and Path(name).suffix) or (key is not None and key not in WRITABLE):
        raise UnsupportedFormatError(
            f"No format that is written has the extension of {Path(name).name!r}. Writable are "
            f"{_described(WRITABLE)}.",
            formats=list(WRITABLE),
        )
    return key or "ply"


def _declared_by(module: Reader, file: IO[bytes], limits: Limits) -> Declared | None:
    """Return the declared size; the position of the file stays."""
    if not hasattr(module, "declared"):
        return None
    here = file.tell()
    size: Declared | None = module.declared(file, limits)
    file.seek(here)
    return size


def _reader(name: str) -> Reader:
    if name not in FORMATS:
        raise UnsupportedFormatError(
            f"There is no format {name!r}. There are {_described(FORMATS)}.", formats=list(FORMATS)
        )
    return FORMATS[name]


def _writer(name: str) -> Format:
    if name not in WRITABLE:
        problem = "is read only" if name in FORMATS else "is unknown"
        raise UnsupportedFormatError(
            f"The format {name!r} {problem}. Writable are {_described(WRITABLE)}.",
            formats=list(WRITABLE),
        )
    return WRITABLE[name]


def _by_extension(name: str) -> str | None:
    extension = Path(name).suffix.lower()
    return next((key for key, module in FORMATS.items() if extension in module.EXTENSIONS), None)


def _described(modules: Mapping[str, Reader]) -> str:
    return ", ".join(
        f"{key} ({' '.join(module.EXTENSIONS)})" if module.EXTENSIONS else key
        for key, module in modules.items()
    )
