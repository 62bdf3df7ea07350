# SPDX-License-Identifier: Apache-2.0
"""Reading and writing point clouds.

A new file format is one new module with the names of `Format`, entered in ``_MODULES``; with
those of `ByRows`, if it can, in ``BY_ROWS`` too.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Protocol

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError, UnsupportedFormatError
from pugeo_model.formats import json_points, npy, npz, ply, ply_ascii, xyz
from pugeo_model.formats.limits import DEFAULT_LIMITS, Limits
from pugeo_model.formats.stream import Source, Target, replacing, seekable

__all__ = [
    "BY_ROWS",
    "FORMATS",
    "ByRows",
    "Format",
    "Limits",
    "by_rows",
    "detect",
    "read",
    "write",
    "written_as",
]


class Format(Protocol):
    """What a module must have to be a format.

    Attributes:
        NAME: key in ``FORMATS``.
        EXTENSIONS: file name endings in lower case, with the dot.
        MEDIA_TYPES: the first one is what the format is served as.
    """

    NAME: str
    EXTENSIONS: tuple[str, ...]
    MEDIA_TYPES: tuple[str, ...]

    def sniff(self, head: bytes, /) -> bool:
        """Whether a file that begins with these bytes is of this format."""

    def read(self, file: IO[bytes], limits: Limits, /) -> Cloud:
        """Read a seekable file from its current position."""

    def write(self, cloud: Cloud, file: IO[bytes], /) -> None:
        """Write a cloud; the file need not be seekable."""


class ByRows(Protocol):
    """What a format has besides whose rows follow each other: it is written part by part."""

    def head(self, cloud: Cloud, count: int, /) -> bytes:
        """What comes before the rows of ``count`` points like those of the cloud."""

    def rows(self, cloud: Cloud, /) -> Iterator[bytes]:
        """The rows of some of the points."""


# Asked in this order: what is recognised by less comes later.
_MODULES: tuple[Format, ...] = (ply_ascii, ply, npz, npy, json_points, xyz)

FORMATS: dict[str, Format] = {module.NAME: module for module in _MODULES}

BY_ROWS: dict[str, ByRows] = {"ply": ply, "ply-ascii": ply_ascii, "xyz": xyz}

_HEAD_BYTES = 4096


def detect(file: IO[bytes], *, name: str | None = None) -> str:
    """Tell the format of a file: by its content, else by the extension of its name.

    Args:
        file: seekable; its position stays.
        name: file name, as far as it is known.

    Returns:
        A key of ``FORMATS``.

    Raises:
        UnsupportedFormatError: neither says anything.
        MalformedFileError: the file is empty.
    """
    here = file.tell()
    head = file.read(_HEAD_BYTES)
    file.seek(here)
    if not head:
        raise MalformedFileError("The file is empty.", code="empty")
    for key, module in FORMATS.items():
        if module.sniff(head):
            return key
    if name is not None and (found := _by_extension(name)) is not None:
        return found
    raise UnsupportedFormatError(
        f"The content is of no known format. Readable are {_known()}.",
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
    """
    module = None if format is None else _named(format)
    with seekable(source, limits) as file:
        if module is None:
            name = os.fspath(source) if isinstance(source, str | os.PathLike) else None
            module = FORMATS[detect(file, name=name)]
        return module.read(file, limits)


def write(cloud: Cloud, target: Target, *, format: str | None = None) -> None:
    """Write a point cloud.

    Args:
        cloud: what to write; its notes are not part of any format.
        target: path, replaced only once the file is complete; or binary file, left open.
        format: a key of ``FORMATS``; by the path's extension, else ``"ply"``, where ``None``.

    Raises:
        UnsupportedFormatError: no such format, or an extension that belongs to none.
        OSError: the path cannot be written.
    """
    if isinstance(target, str | os.PathLike):
        path = os.fspath(target)
        module = _named(format or written_as(path))
        with replacing(path) as file:
            module.write(cloud, file)
    else:
        _named(format or "ply").write(cloud, target)


def by_rows(cloud: Cloud, format: str) -> bool:
    """Whether clouds like this one can be written part by part, by the format in ``BY_ROWS``.

    Scalars of 64-bit integers are stored in whatever holds all values, which no part knows.
    """
    wide = any(v.dtype.kind in "iu" and v.dtype.itemsize == 8 for v in cloud.scalars.values())
    return format in BY_ROWS and not wide


def written_as(path: str | os.PathLike[str]) -> str:
    """The format that `write` takes for a path: by its extension, ``"ply"`` without one.

    Raises:
        UnsupportedFormatError: an extension that belongs to none.
    """
    name = os.fspath(path)
    key = _by_extension(name)
    if key is None and Path(name).suffix:
        raise UnsupportedFormatError(
            f"No format has the extension of {Path(name).name!r}. Writable are {_known()}.",
            formats=list(FORMATS),
        )
    return key or "ply"


def _named(name: str) -> Format:
    if name not in FORMATS:
        raise UnsupportedFormatError(
            f"There is no format {name!r}. There are {_known()}.", formats=list(FORMATS)
        )
    return FORMATS[name]


def _by_extension(name: str) -> str | None:
    extension = Path(name).suffix.lower()
    return next((key for key, module in FORMATS.items() if extension in module.EXTENSIONS), None)


def _known() -> str:
    return ", ".join(
        f"{key} ({' '.join(module.EXTENSIONS)})" if module.EXTENSIONS else key
        for key, module in FORMATS.items()
    )
