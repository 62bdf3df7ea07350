# SPDX-License-Identifier: Apache-2.0
"""The dense cloud that came back, in memory or on disk."""

import io
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pugeo_client._atomic import atomic_file
from pugeo_client._ply import read_ply
from pugeo_client.errors import InvalidResponseError, SourceError

__all__ = ["Meta", "Result"]

_COORDINATES = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOR = ("red", "green", "blue", "alpha")


@dataclass(frozen=True)
class Meta:
    """What the service said about a result.

    Attributes:
        model_version: version of the model. Empty, like all that follows, where the service did
            not say.
        model_sha256: checksum of its weights.
        request_id: names the request in the service's log.
        points_in: points in the file that was sent.
        points_out: points of the result.
        dropped: reason -> how many input points were left out (non-finite, duplicate).
        timings: stage -> seconds on the service.
        notes: sentences about what the service guessed or left out.
    """

    model_version: str = ""
    model_sha256: str = ""
    request_id: str = ""
    points_in: int | None = None
    points_out: int | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Result:
    """A dense cloud. Its arrays are made when first asked for.

    Attributes:
        meta: what the service said about it.
        format: ``"ply"``, ``"npz"`` and so on: what `data` or the file at `path` is.
        data: the answer as it came, or None if it went to disk.
        path: the file it went to, or None if it is in memory.
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

    @property
    def points(self) -> NDArray[Any]:
        """``(M, 3)`` float32, or float64 where the input was: cloud units, the input's frame."""
        points: NDArray[Any] = self._arrays["points"]
        return points

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """``(M, 3)`` float32 of unit length, or None."""
        return self._arrays.get("normals")

    @property
    def colors(self) -> NDArray[np.uint8] | None:
        """``(M, 3)`` RGB or ``(M, 4)`` RGBA uint8, or None if the input had none."""
        return self._arrays.get("colors")

    @property
    def scalars(self) -> dict[str, NDArray[Any]]:
        """Name -> ``(M,)``: intensity, class and whatever else the input carried."""
        scalars: dict[str, NDArray[Any]] = self._arrays["scalars"]
        return scalars

    def save(self, path: str | Path) -> Path:
        """Write the cloud to a file, in whole or not at all; an older file is replaced.

        The extension chooses: ``.ply`` (the bytes as they came), ``.npz`` (all arrays by name),
        ``.npy`` (points, and normals as columns 4 to 6), ``.xyz`` (the same as text, then colours).

        Raises:
            SourceError: another extension, or a ``.ply`` of an answer that was none.
            InvalidResponseError: the answer cannot be read.
        """
        target = Path(path)
        suffix = target.suffix.lower()
        if suffix == f".{self.format}":
            write = self._copy
        elif suffix in _WRITERS:
            write = self._writer(suffix)
        else:
            known = ", ".join(sorted({*_WRITERS, f".{self.format}"}))
            raise SourceError(f"cannot write {target.name}: known extensions are {known}")
        with atomic_file(target) as file:
            write(file)
        return target

    def _copy(self, file: BinaryIO) -> None:
        if self.data is not None:
            file.write(self.data)
        elif self.path is not None:
            with self.path.open("rb") as source:
                shutil.copyfileobj(source, file)

    def _writer(self, suffix: str) -> Any:
        arrays = self._arrays  # read before the target is opened: it may be the same file
        return lambda file: _WRITERS[suffix](arrays, file)

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        data = self.data if self.path is None else self.path.read_bytes()
        if data is None or self.format not in _READERS:
            raise InvalidResponseError(
                f"arrays are read from ply, npz and npy, not from {self.format}"
            )
        return _READERS[self.format](data)


def _from_ply(data: bytes) -> dict[str, Any]:
    columns = read_ply(data)
    if not set(_COORDINATES) <= set(columns):
        raise InvalidResponseError("the answer has no x, y, z")

    def together(names: tuple[str, ...]) -> NDArray[Any] | None:
        present = [columns.pop(name) for name in names if name in columns]
        return np.stack(present, axis=1) if present else None

    return {
        "points": together(_COORDINATES),
        "normals": together(_NORMAL),
        "colors": together(_COLOR),
        "scalars": columns,
    }


def _from_npz(data: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(data), allow_pickle=False) as packed:
        arrays: dict[str, Any] = dict(packed)
    known = {name: arrays.pop(name, None) for name in ("points", "normals", "colors")}
    return {**known, "scalars": arrays}


def _from_npy(data: bytes) -> dict[str, Any]:
    rows = np.load(io.BytesIO(data), allow_pickle=False)
    normals = rows[:, 3:6] if rows.shape[1] >= 6 else None
    return {"points": rows[:, :3], "normals": normals, "colors": None, "scalars": {}}


def _to_npz(arrays: dict[str, Any], file: BinaryIO) -> None:
    named = arrays["scalars"] | {name: arrays[name] for name in ("points", "normals", "colors")}
    np.savez(file, **{name: values for name, values in named.items() if values is not None})


def _to_npy(arrays: dict[str, Any], file: BinaryIO) -> None:
    np.save(file, _columns(arrays, "points", "normals"))


def _to_xyz(arrays: dict[str, Any], file: BinaryIO) -> None:
    digits = 9 if arrays["points"].dtype == np.float32 else 17  # enough to read the same back
    formats = [f"%.{digits}g"] * 3
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
