# SPDX-License-Identifier: Apache-2.0
"""Meaning of columns: by their names where there are names, else guessed from their values."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import UntreatableCloudError
from pugeo_model.formats.colors import to_channels

__all__ = ["are_whole", "from_array", "guess", "standard_name"]

_UNIT = 1e-2
"""Largest deviation of a normal's length from 1."""
_FEWEST = 100
"""Rows from which on small whole numbers (see `_DARK`) are taken for labels, not for colours."""
_DARK = 31
"""Colours brighter than this are expected in a column of `_FEWEST` rows. Return numbers and most
classes of LiDAR are not above it."""

_ALIASES = {
    "x": "x easting east longitude lon lng long coordx xcoord xcoordinate pointx positionx "
    "pointsx pointspositionx",
    "y": "y northing north latitude lat coordy ycoord ycoordinate pointy positiony pointsy",
    "z": "z elevation elev height altitude alt coordz zcoord zcoordinate pointz positionz pointsz",
    "red": "red r rf",
    "green": "green g gf",
    "blue": "blue b bf",
    "nx": "nx normalx xnormal",
    "ny": "ny normaly ynormal",
    "nz": "nz normalz znormal",
    "alpha": "alpha a",
}
_STANDARD = {alias: name for name, aliases in _ALIASES.items() for alias in aliases.split()}


def standard_name(name: str) -> str | None:
    """The PLY name (``x``, ``red``, ``nx``, ...) that a column name stands for, or ``None``.

    Case, quotes, units in brackets and separators do not count: ``"X [m]"`` is ``x``.
    """
    plain = re.sub(r"[(\[{].*", "", name.lower())
    return _STANDARD.get(re.sub(r"[^a-z0-9]", "", plain))


def are_whole(values: NDArray[Any]) -> bool:
    """True if all values are whole numbers that float64 holds exactly (NaN is none)."""
    with np.errstate(invalid="ignore"):
        return bool(((np.abs(values) <= 2**53) & (values == np.rint(values))).all())


def from_array(values: NDArray[Any]) -> Cloud:
    """Build a cloud from an array of numbers; columns after x, y, z are guessed, see `guess`.

    Args:
        values: ``(M, K)`` with K at least 3. Half and single precision become float32, all other
            types float64.

    Raises:
        UntreatableCloudError: another shape, or no numbers.
    """
    if values.ndim != 2 or values.shape[1] < 3 or values.dtype.kind not in "fiu":
        raise UntreatableCloudError(
            f"An array must hold numbers of shape (M, 3) or more columns, not {values.dtype} "
            f"{values.shape}.",
            code="bad_array",
        )
    small = values.dtype.kind == "f" and values.dtype.itemsize <= 4
    return guess(values.astype(np.float32 if small else np.float64, copy=False))


def guess(table: NDArray[Any], *, counted: bool = False) -> Cloud:
    """Guess the meaning of unnamed columns from their values; each guess is noted.

    The first three columns are x, y, z. Then, from left to right, three columns are

    - normals where all rows have unit length, or are zero or missing,
    - colours right after x, y, z, after normals or after one column more, where all values are
      whole numbers in 0..255 (or in 0..65535 right after x, y, z where nothing else follows),
    - colours right after x, y, z where all values are in 0..1 and nothing or normals follow.

    Every other column is a scalar ``c3``, ``c4``, ...; a label where all its values are whole.

    Args:
        table: ``(M, K)`` float32 or float64.
        counted: a count came before the rows, as in PTS files, where one column more is the
            intensity, before any colours.
    """
    points = np.ascontiguousarray(table[:, :3])
    normals: NDArray[np.float32] | None = None
    colors: NDArray[Any] | None = None
    notes: list[str] = []
    extras: list[int] = []
    # An unnamed last column without any value comes from a separator at the end of each line.
    while table.shape[1] > 3 and len(table) and np.isnan(table[:, -1]).all():
        table = table[:, :-1]
    column, width = 3, table.shape[1]
    while column < width:
        triple = table[:, column : column + 3]
        found = _kind(table, column, counted) if column + 3 <= width else None
        if found == "normals" and normals is None:
            with np.errstate(over="ignore", invalid="ignore"):
                normals = np.ascontiguousarray(triple, np.float32)
            notes.append(f"Columns {_span(column)} have unit length and were read as normals.")
            column += 3
        elif found == "colours" and colors is None:
            colors = _channels(triple)
            notes.append(f"Columns {_span(column)} were read as red, green, blue.")
            column += 3
        else:
            extras.append(column)
            column += 1
    scalars = _scalars(table, extras, counted or (colors is not None and extras == [3]))
    if scalars:
        notes.append(f"Unnamed columns were read as scalars: {', '.join(scalars)}.")
    return Cloud(points, normals, colors, scalars, tuple(notes))


def _span(column: int) -> str:
    return f"{column + 1} to {column + 3}"


def _kind(table: NDArray[Any], column: int, counted: bool) -> str | None:
    """Guess whether the three columns from ``column`` on are normals or colours."""
    triple, width = table[:, column : column + 3], table.shape[1]
    if not len(table):
        return None
    if _are_unit(triple):
        return "normals"
    if counted and column == 3 and width == 7:
        # PTS: the intensity comes first.
        return None
    last = column + 3 == width
    beside_normals = last and column == 6 and _are_unit(table[:, 3:6])
    before_normals = width == 9 and column == 3 and _are_unit(table[:, 6:9])
    alone = last and column == 3
    found = (
        ((column in (3, 6) or (column == 4 and last)) and _are_bytes(triple, strict=not counted))
        or (alone and _are_whole_up_to(triple, 65535) and triple.max() > 255)
        or ((alone or before_normals or beside_normals) and _are_shares(triple))
    )
    return "colours" if found else None


def _channels(triple: NDArray[Any]) -> NDArray[Any]:
    if _are_whole_up_to(triple, 255) and triple.max(initial=0) > 1:
        return triple.astype(np.uint8)
    return to_channels(triple)[0]


def _scalars(
    table: NDArray[Any], columns: Sequence[int], intensity: bool
) -> dict[str, NDArray[Any]]:
    scalars: dict[str, NDArray[Any]] = {}
    for column in columns:
        values = np.ascontiguousarray(table[:, column])
        name = "intensity" if intensity and column == 3 else f"c{column}"
        if name != "intensity" and are_whole(values):
            values = values.astype(np.int64)
        scalars[name] = values
    return scalars


def _are_unit(rows: NDArray[Any]) -> bool:
    """True if rows have unit length; up to half of them may be zero or missing."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt((rows.astype(np.float64) ** 2).sum(axis=1))
        unit = np.abs(lengths - 1.0) <= _UNIT
    absent = (lengths == 0.0) | np.isnan(lengths)
    return bool((unit | absent).all() and np.count_nonzero(unit) >= max(1, len(rows) / 2))


def _are_bytes(rows: NDArray[Any], *, strict: bool) -> bool:
    if not _are_whole_up_to(rows, 255):
        return False
    return not strict or len(rows) < _FEWEST or bool(rows.max(initial=0) > _DARK)


def _are_whole_up_to(rows: NDArray[Any], top: int) -> bool:
    return bool(((rows >= 0) & (rows <= top) & (rows == np.rint(rows))).all())


def _are_shares(rows: NDArray[Any]) -> bool:
    """True if all values are in 0..1 and not all of them whole."""
    return bool(((rows >= 0) & (rows <= 1)).all() and (rows != np.rint(rows)).any())
