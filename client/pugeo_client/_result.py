# SPDX-License-Identifier: Apache-2.0
"""The dense cloud of an answer, in memory or on disk."""

import html
import importlib
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pugeo_client._atomic import atomic_file
from pugeo_client._npz import read_npy, read_npz, write_npz
from pugeo_client._picture import picture
from pugeo_client._ply import read_ply
from pugeo_client.errors import InvalidResponseError, PugeoError, SourceError

__all__ = ["Meta", "Result"]

_COORDINATES = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOR = ("red", "green", "blue", "alpha")
_ARRAYS = ("points", "normals", "colors")


@dataclass(frozen=True)
class Meta:
    """Description of a result, from the headers of the answer.

    Attributes:
        model: name of the model. Empty, like all that follows, where the service did not say.
        model_version: its version.
        model_sha256: checksum of its weights.
        request_id: id of the request in the log of the service.
        points_in: number of points in the input.
        points_out: number of points in the result.
        dropped: reason -> number of input points left out: ``non_finite``, ``duplicate``,
            ``wild``.
        timings: stage -> seconds on the service.
        notes: sentences about what the service guessed or left out.
    """

    model: str = ""
    model_version: str = ""
    model_sha256: str = ""
    request_id: str = ""
    points_in: int | None = None
    points_out: int | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Result:
    """A dense cloud. Its arrays are read when first used.

    Attributes:
        meta: description of the result.
        format: format of `data` or of the file at `path`: ``"ply"``, ``"npz"`` and so on.
        data: the answer, or None if it is on disk.
        path: the output file, or None if the answer is in memory.
    """

    def __init__(
        self, meta: Meta, *, format: str, data: bytes | None = None, path: Path | None = None
    ) -> None:
        if (data is None) == (path is None):
            raise ValueError("a result lies either in memory or on disk")
        self.meta = meta
        self.format = format
        self.data = data
        self.path = path

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        where = f"{len(self.data)} bytes" if self.data is not None else str(self.path)
        return f"<Result {self.meta.points_out} points, {self.format}, {where}>"

    def _repr_html_(self) -> str:
        """Return a small picture for notebooks; the text of `repr` where arrays are not read."""
        text = html.escape(repr(self))
        try:
            return picture(self.points, self.normals, self.colors, caption=text)
        except (PugeoError, OSError):
            return text

    @property
    def points(self) -> NDArray[Any]:
        """``(M, 3)`` float32, or float64 if the input was: units and frame of the input."""
        points: NDArray[Any] = self._arrays["points"]
        return points

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """``(M, 3)`` float32 of unit length, or None."""
        normals: NDArray[np.float32] | None = self._arrays["normals"]
        return normals

    @property
    def colors(self) -> NDArray[np.uint8] | None:
        """``(M, 3)`` RGB or ``(M, 4)`` RGBA uint8, or None if the input had none."""
        colors: NDArray[np.uint8] | None = self._arrays["colors"]
        return colors

    @property
    def scalars(self) -> dict[str, NDArray[Any]]:
        """Name -> ``(M,)``: intensity, class and all other attributes of the input."""
        scalars: dict[str, NDArray[Any]] = self._arrays["scalars"]
        return scalars

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the cloud to a file atomically; an older file is replaced.

        The extension chooses the format: that of the answer is copied byte for byte; ``.npz`` has
        all arrays by name, ``.npy`` points and normals (columns 4 to 6), ``.xyz`` the same as
        text, followed by colours.

        Raises:
            SourceError: another extension.
            InvalidResponseError: the answer cannot be read.
            OSError: the file cannot be written.
        """
        target = Path(path)
        suffix = target.suffix.lower()
        own = f".{self.format.partition('-')[0]}"
        if suffix == own:
            write: Callable[[BinaryIO], None] = self._copy
        elif suffix in _WRITERS:
            write = self._writer(suffix)
        else:
            known = ", ".join(sorted({*_WRITERS, own}))
            raise SourceError(f"cannot write {target.name}: known extensions are {known}")
        with atomic_file(target) as file:
            write(file)
        return target

    def to_open3d(self) -> Any:
        """Return an ``open3d.geometry.PointCloud`` with points, normals and colours.

        Open3D has no place for `scalars` in it.

        Raises:
            ImportError: Open3D is not installed.
            InvalidResponseError: the answer cannot be read.
        """
        try:
            open3d: Any = importlib.import_module("open3d")
        except ImportError as error:
            raise ImportError("to_open3d() needs Open3D: pip install open3d") from error
        vectors = open3d.utility.Vector3dVector
        cloud = open3d.geometry.PointCloud(vectors(np.asarray(self.points, dtype=np.float64)))
        if self.normals is not None:
            cloud.normals = vectors(np.asarray(self.normals, dtype=np.float64))
        if self.colors is not None:
            cloud.colors = vectors(self.colors[:, :3] / 255.0)
        return cloud

    def _copy(self, file: BinaryIO) -> None:
        if self.data is not None:
            file.write(self.data)
        else:
            with self._file().open("rb") as source:
                shutil.copyfileobj(source, file)

    def _file(self) -> Path:
        """Return `path`, if the answer can be read back from there."""
        if self.path is None or not self.path.is_file():
            raise PugeoError(f"the answer cannot be read back: {self.path} is no file")
        return self.path

    def _writer(self, suffix: str) -> Callable[[BinaryIO], None]:
        arrays = self._arrays  # read before the target is opened: it may be the same file
        return lambda file: _WRITERS[suffix](arrays, file)

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        if self.format not in _READERS:
            raise InvalidResponseError(
                f"arrays are read from ply, npz and npy, not from {self.format}"
            )
        data = self._file().read_bytes() if self.data is None else self.data
        arrays = _READERS[self.format](data)
        points = arrays["points"]
        if points is None or points.ndim != 2 or points.shape[1] != len(_COORDINATES):
            raise InvalidResponseError("the answer has no points of x, y, z")
        return arrays


def _from_ply(data: bytes) -> dict[str, Any]:
    columns = read_ply(data)

    def stacked(names: tuple[str, ...]) -> NDArray[Any] | None:
        if not set(names[:3]) <= set(columns):
            return None
        return np.stack([columns.pop(name) for name in names if name in columns], axis=1)

    arrays = dict(zip(_ARRAYS, map(stacked, (_COORDINATES, _NORMAL, _COLOR)), strict=True))
    return {**arrays, "scalars": columns}


def _from_npz(data: bytes) -> dict[str, Any]:
    arrays = read_npz(data)
    return {**{name: arrays.pop(name, None) for name in _ARRAYS}, "scalars": arrays}


def _from_npy(data: bytes) -> dict[str, Any]:
    rows = read_npy(data)
    columns = rows.shape[1] if rows.ndim == 2 else 0
    return {
        "points": rows[:, :3] if columns else None,
        "normals": rows[:, 3:6] if columns >= 6 else None,
        "colors": None,
        "scalars": {},
    }


def _to_npz(arrays: dict[str, Any], file: BinaryIO) -> None:
    named = {name: arrays[name] for name in _ARRAYS if arrays[name] is not None}
    write_npz(file, named | arrays["scalars"])


def _to_npy(arrays: dict[str, Any], file: BinaryIO) -> None:
    np.save(file, _columns(arrays, "points", "normals"))


def _to_xyz(arrays: dict[str, Any], file: BinaryIO) -> None:
    # 9 and 17 significant digits give the same float32 and float64 back.
    formats = ["%.9g" if arrays["points"].dtype == np.float32 else "%.17g"] * 3
    if arrays["normals"] is not None:
        formats += ["%.9g"] * 3
    if arrays["colors"] is not None:
        formats += ["%d"] * arrays["colors"].shape[1]
    rows = _columns(arrays, "points", "normals", "colors").astype(np.float64)
    np.savetxt(file, rows, fmt=" ".join(formats))


def _columns(arrays: dict[str, Any], *names: str) -> NDArray[Any]:
    return np.concatenate([arrays[name] for name in names if arrays[name] is not None], axis=1)


_READERS = {"ply": _from_ply, "npz": _from_npz, "npy": _from_npy}
_WRITERS = {".npz": _to_npz, ".npy": _to_npy, ".xyz": _to_xyz}
