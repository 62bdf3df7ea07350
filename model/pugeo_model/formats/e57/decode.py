# SPDX-License-Identifier: Apache-2.0
"""The scans of an E57 file as one cloud."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import CloudError, MalformedFileError
from pugeo_model.formats.colors import to_channels
from pugeo_model.formats.e57.library import import_libe57, on_disk
from pugeo_model.formats.limits import Limits

__all__ = ["read"]

_BLOCK_ROWS = 1 << 16
_MOST_SCANS = 10_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")
_INDICES = ("rowIndex", "columnIndex", "returnIndex", "returnCount")
_OWN = ("intensity", "timeStamp", *_INDICES)
_FLAGS = {"intensity": "isIntensityInvalid", "timeStamp": "isTimeStampInvalid"}
_READ = frozenset([*_CARTESIAN, *_SPHERICAL, *_COLORS, *_NORMALS, *_INVALID, *_OWN])


@dataclass(frozen=True)
class _Scan:
    """One scan in the frame of the file.

    Attributes:
        points: ``(n, 3)`` float64.
        columns: field -> ``(n,)`` float64.
        colors: ``(n, 3)`` or ``None``.
        normals: ``(n, 3)`` float64 or ``None``.
        position: ``(3,)`` scanner position, or ``None`` without a pose.
        invalid: points that were left out because they are marked as invalid.
        notes: about this scan.
    """

    points: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    colors: NDArray[Any] | None
    normals: NDArray[np.float64] | None
    position: NDArray[np.float64] | None
    invalid: int
    notes: tuple[str, ...]


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read all scans, each moved by its pose; points become float64.

    The position of a scan's pose is the viewpoint of its points, and the scalar ``scan`` (from 0)
    tells scans apart where there are several. Points marked as invalid are left out; intensities
    and times marked as invalid are NaN. Colours are scaled by their limits.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` bounds the points of all scans together.

    Raises:
        MalformedFileError: broken, or without scans.
        LimitExceededError: more points than ``limits``.
        UnsupportedFormatError: pye57 is not installed.
    """
    libe57 = import_libe57()
    with on_disk(file) as path, _as_malformed():
        image = libe57.ImageFile(path, "r")
        try:
            return _read_image(libe57, image, limits)
        finally:
            image.close()


def _read_image(libe57: Any, image: Any, limits: Limits) -> Cloud:
    root = image.root()
    if not root.isDefined("data3D"):
        raise MalformedFileError("The E57 file has no scans.", code="missing_property")
    nodes = root["data3D"]
    count = len(nodes)
    if not 0 < count <= _MOST_SCANS:
        raise MalformedFileError(
            f"The E57 file has {count:,} scans; 1 to {_MOST_SCANS:,} are read.",
            code="missing_property",
        )
    total = sum(int(nodes[index]["points"].childCount()) for index in range(count))
    limits.check("max_points", total, "Points of the E57 scans")
    scans = [_read_scan(libe57, image, nodes[index]) for index in range(count)]
    crs = None
    if root.isDefined("coordinateMetadata"):
        crs = root["coordinateMetadata"].value() or None
    return _joined(scans, crs)


@contextmanager
def _as_malformed() -> Iterator[None]:
    """Turn the errors of the library about broken bytes into one."""
    try:
        yield
    except CloudError:
        raise
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise MalformedFileError(
            f"The E57 file cannot be read: {reason}", code="bad_row"
        ) from error


def _read_scan(libe57: Any, image: Any, node: Any) -> _Scan:
    vector = node["points"]
    prototype = libe57.StructureNode(vector.prototype())
    fields = [prototype.get(index).elementName() for index in range(prototype.childCount())]
    wanted = [name for name in fields if name in _READ or name in _FLAGS.values()]
    cartesian = all(name in fields for name in _CARTESIAN)
    if not cartesian and not all(name in fields for name in _SPHERICAL):
        raise MalformedFileError(
            "A scan of the E57 file has neither cartesian nor spherical coordinates.",
            code="missing_property",
        )
    columns = _columns(libe57, image, vector, wanted)
    valid = np.ones(len(columns[wanted[0]]), np.bool_)
    state = _INVALID[0] if cartesian else _INVALID[1]
    if state in columns:
        valid = columns[state] == 0
    columns = {name: values[valid] for name, values in columns.items()}
    local = _local(columns, cartesian=cartesian)
    rotation, position = _pose(node)
    turn = np.eye(3) if rotation is None else rotation
    with np.errstate(over="ignore", invalid="ignore"):
        points = local @ turn.T + (0.0 if position is None else position)
    normals = None
    if all(name in columns for name in _NORMALS):
        normals = np.stack([columns[name] for name in _NORMALS], axis=1) @ turn.T
    for name, flag in _FLAGS.items():
        if name in columns and flag in columns:
            columns[name][columns[flag] != 0] = np.nan
    dropped = sorted(set(fields) - set(wanted) - {"isColorInvalid"})
    notes = [f"Fields of a scan are dropped: {', '.join(dropped)}."] if dropped else []
    return _Scan(
        points,
        {name: columns[name] for name in _OWN if name in columns},
        _colors(node, columns, notes),
        normals,
        position,
        int(np.count_nonzero(~valid)),
        tuple(notes),
    )


def _columns(
    libe57: Any, image: Any, vector: Any, wanted: list[str]
) -> dict[str, NDArray[np.float64]]:
    """Read fields as float64, block by block: a declared count allocates nothing by itself."""
    rows = min(_BLOCK_ROWS, max(1, int(vector.childCount())))
    block = {name: np.zeros(rows) for name in wanted}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in block.items():
        buffers.append(libe57.SourceDestBuffer(image, name, values, rows, True, True))
    parts: dict[str, list[NDArray[np.float64]]] = {name: [] for name in wanted}
    reader = vector.reader(buffers)
    try:
        while found := int(reader.read()):
            for name, values in block.items():
                parts[name].append(values[:found].copy())
    finally:
        reader.close()
    return {name: np.concatenate(each) if each else np.zeros(0) for name, each in parts.items()}


def _local(columns: dict[str, NDArray[np.float64]], *, cartesian: bool) -> NDArray[np.float64]:
    if cartesian:
        return np.stack([columns[name] for name in _CARTESIAN], axis=1)
    distance, azimuth, elevation = (columns[name] for name in _SPHERICAL)
    with np.errstate(over="ignore", invalid="ignore"):
        flat = distance * np.cos(elevation)
        return np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
        )


def _pose(node: Any) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Rotation ``(3, 3)`` and position ``(3,)`` of a scan, as far as they are given."""
    if not node.isDefined("pose"):
        return None, None
    pose = node["pose"]
    rotation = None
    if pose.isDefined("rotation"):
        rotation = _rotation(np.array([pose["rotation"][axis].value() for axis in "wxyz"], float))
    position = np.zeros(3)
    if pose.isDefined("translation"):
        position = np.array([pose["translation"][axis].value() for axis in "xyz"], float)
    if not np.isfinite(position).all():
        raise MalformedFileError("The pose of an E57 scan is not finite.", code="bad_header")
    return rotation, position


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix of a quaternion w x y z, which need not have unit length."""
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(length) and length > 0):
        raise MalformedFileError("The pose of an E57 scan has no rotation.", code="bad_header")
    w, x, y, z = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _colors(
    node: Any, columns: dict[str, NDArray[np.float64]], notes: list[str]
) -> NDArray[Any] | None:
    """Colours, scaled by the limits that the scan declares for them."""
    if not all(name in columns for name in _COLORS):
        return None
    values = np.stack([columns[name] for name in _COLORS], axis=1)
    top = 255.0
    if node.isDefined("colorLimits"):
        limits = node["colorLimits"]
        tops = [
            float(limits[f"{n}Maximum"].value()) for n in _COLORS if limits.isDefined(f"{n}Maximum")
        ]
        top = max(tops, default=255.0)
    elif values.max(initial=0) > 255:
        top = 65535.0
    if top == 255.0:
        return np.clip(np.nan_to_num(values), 0, 255).astype(np.uint8)
    if top > 255.0:
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = np.rint(np.nan_to_num(values) * (65535.0 / top))
        return np.clip(scaled, 0, 65535).astype(np.uint16)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        colors, note = to_channels(values / top)
    notes += [note] if note else []
    return colors


def _joined(scans: list[_Scan], crs: str | None) -> Cloud:
    notes = [note for scan in scans for note in scan.notes]
    if invalid := sum(scan.invalid for scan in scans):
        notes.append(f"{invalid:,} points that the file marks as invalid are left out.")

    def shared(values: list[NDArray[Any] | None], label: str) -> NDArray[Any] | None:
        there = [each for each in values if each is not None]
        if len(there) < len(values):
            if there:
                notes.append(f"{label} that only some scans have are dropped.")
            return None
        kinds = {each.dtype for each in there}
        if len(kinds) > 1:  # 8-bit colours beside 16-bit ones
            there = [e * np.uint16(257) if e.dtype == np.uint8 else e for e in there]
        return np.concatenate(there)

    scalars: dict[str, NDArray[Any]] = {}
    for name in _OWN:
        values = shared([scan.columns.get(name) for scan in scans], f"Values of {name}")
        if values is not None:
            whole = (
                name in _INDICES and np.isfinite(values).all() and (np.abs(values) < 2**53).all()
            )
            scalars[name] = values.astype(np.int64) if whole else values
    if len(scans) > 1:
        sizes = [len(scan.points) for scan in scans]
        scalars["scan"] = np.repeat(np.arange(len(scans), dtype=np.uint16), sizes)
    positions = [scan.position for scan in scans if scan.position is not None]
    normals = shared([scan.normals for scan in scans], "Normals")
    with np.errstate(over="ignore", invalid="ignore"):
        turned = None if normals is None else normals.astype(np.float32)
    return Cloud(
        np.concatenate([scan.points for scan in scans]),
        turned,
        shared([scan.colors for scan in scans], "Colours"),
        scalars,
        tuple(dict.fromkeys(notes)),
        viewpoints=np.stack(positions) if len(positions) == len(scans) else None,
        source=SourceInfo("e57", crs),
    )
