# SPDX-License-Identifier: Apache-2.0
"""A cloud as E57: one scan for each viewpoint."""

import hashlib
import shutil
import tempfile
import uuid
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.formats.e57.library import import_libe57

__all__ = ["WRITTEN", "write"]

_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_BLOCK_ROWS = 1 << 16

WRITTEN = ("intensity", "timeStamp", "rowIndex", "columnIndex", "returnIndex", "returnCount")
"""Scalars that the standard has a field for."""

_Fields = dict[str, NDArray[Any]]


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write all points as double (as single where the cloud is), with normals by the extension.

    Points of a scan are stored relative to its viewpoint, which becomes the position of its pose;
    a cloud without viewpoints is one scan without a pose. The same cloud always gives the same
    bytes.

    Raises:
        UnsupportedFormatError: pye57 is not installed.
    """
    libe57 = import_libe57()
    with tempfile.TemporaryDirectory(prefix="pugeo-") as folder:
        path = Path(folder) / "cloud.e57"
        image = libe57.ImageFile(str(path), "w")
        try:
            _write_image(libe57, image, cloud)
        finally:
            image.close()
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)


def _write_image(libe57: Any, image: Any, cloud: Cloud) -> None:
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    if cloud.normals is not None:
        image.extensionsAdd("nor", _NORMALS_URI)
    root = image.root()
    crs = cloud.source.crs if cloud.source is not None else None
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(image, _guid(cloud, 0)))
    root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
    root.set("coordinateMetadata", libe57.StringNode(image, crs or ""))
    scans = libe57.VectorNode(image, True)
    root.set("data3D", scans)
    root.set("images2D", libe57.VectorNode(image, True))
    if cloud.viewpoints is None:
        _write_scan(libe57, image, scans, cloud, None, 0)
    elif len(cloud.viewpoints) == 1 or "scan" not in cloud.scalars:
        _write_scan(libe57, image, scans, cloud, cloud.viewpoints[0], 0)
    else:
        for number, position in enumerate(cloud.viewpoints):
            part = cloud.take(cloud.scalars["scan"] == number)
            _write_scan(libe57, image, scans, part, position, number)


def _guid(cloud: Cloud, number: int) -> str:
    """An identifier that only depends on the points."""
    digest = hashlib.sha256(number.to_bytes(4, "little"))
    digest.update(np.ascontiguousarray(cloud.points).data)
    return f"{{{uuid.UUID(bytes=digest.digest()[:16], version=4)}}}"


def _write_scan(
    libe57: Any,
    image: Any,
    scans: Any,
    cloud: Cloud,
    position: NDArray[np.float64] | None,
    number: int,
) -> None:
    scan = libe57.StructureNode(image)
    scan.set("guid", libe57.StringNode(image, _guid(cloud, number + 1)))
    scan.set("name", libe57.StringNode(image, f"Scan {number}"))
    if position is not None:
        scan.set("pose", _pose(libe57, image, position))
    fields = _fields(cloud, position)
    prototype = libe57.StructureNode(image)
    for name, values in fields.items():
        prototype.set(name, _kind(libe57, image, name, values))
    if cloud.colors is not None:
        top = int(np.iinfo(cloud.colors.dtype).max)
        scan.set("colorLimits", _color_limits(libe57, image, top))
    if "intensity" in fields:
        known = fields["intensity"][np.isfinite(fields["intensity"])]
        limits = libe57.StructureNode(image)
        low, high = float(known.min(initial=0.0)), float(known.max(initial=0.0))
        limits.set("intensityMinimum", libe57.FloatNode(image, low))
        limits.set("intensityMaximum", libe57.FloatNode(image, high))
        scan.set("intensityLimits", limits)
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    _write_rows(libe57, image, points, fields)


def _write_rows(libe57: Any, image: Any, points: Any, fields: _Fields) -> None:
    count = len(fields["cartesianX"])
    rows = min(_BLOCK_ROWS, max(1, count))
    block = {name: np.zeros(rows, values.dtype) for name, values in fields.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in block.items():
        buffers.append(libe57.SourceDestBuffer(image, name, values, rows, True, True))
    writer = points.writer(buffers)
    try:
        for start in range(0, count, rows):
            part = slice(start, min(start + rows, count))
            for name, values in fields.items():
                block[name][: part.stop - start] = values[part]
            writer.write(part.stop - start)
    finally:
        writer.close()


def _fields(cloud: Cloud, position: NDArray[np.float64] | None) -> _Fields:
    points = cloud.points
    if position is not None and position.any():
        points = points.astype(np.float64) - position
    fields: _Fields = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
    if cloud.normals is not None:
        fields |= {f"nor:normal{axis}": cloud.normals[:, i] for i, axis in enumerate("XYZ")}
    if cloud.colors is not None:
        for index, name in enumerate(("colorRed", "colorGreen", "colorBlue")):
            fields[name] = cloud.colors[:, index]
    for name in WRITTEN:
        if name in cloud.scalars:
            fields[name] = _storable(cloud.scalars[name])
    if "intensity" in fields:
        known = np.isfinite(fields["intensity"])
        if not known.all():
            fields["isIntensityInvalid"] = (~known).astype(np.int8)
            fields["intensity"] = np.where(known, fields["intensity"], 0.0)
    return {name: np.ascontiguousarray(values) for name, values in fields.items()}


def _storable(values: NDArray[Any]) -> NDArray[Any]:
    """Values in a type that pye57 hands on rightly."""
    if values.dtype.kind == "f":
        return values.astype(np.float32) if values.dtype.itemsize < 4 else values
    # By the letter of its type: pye57 takes "l" for 32 bits, though it has 64 on Linux.
    return values.astype(np.dtype("q"))


def _kind(libe57: Any, image: Any, name: str, values: NDArray[Any]) -> Any:
    """The node that describes the type of a field."""
    if values.dtype.kind == "f":
        single = values.dtype.itemsize == 4
        precision = libe57.E57_SINGLE if single else libe57.E57_DOUBLE
        return libe57.FloatNode(image, 0.0, precision)
    if name.startswith("color"):
        return libe57.IntegerNode(image, 0, 0, int(np.iinfo(values.dtype).max))
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    return libe57.IntegerNode(image, min(max(0, low), high), low, high)


def _pose(libe57: Any, image: Any, position: NDArray[np.float64]) -> Any:
    pose = libe57.StructureNode(image)
    rotation, translation = libe57.StructureNode(image), libe57.StructureNode(image)
    for axis, value in zip("wxyz", (1.0, 0.0, 0.0, 0.0), strict=True):
        rotation.set(axis, libe57.FloatNode(image, value))
    for axis, value in zip("xyz", position.tolist(), strict=True):
        translation.set(axis, libe57.FloatNode(image, value))
    pose.set("rotation", rotation)
    pose.set("translation", translation)
    return pose


def _color_limits(libe57: Any, image: Any, top: int) -> Any:
    limits = libe57.StructureNode(image)
    for name in ("colorRed", "colorGreen", "colorBlue"):
        limits.set(f"{name}Minimum", libe57.IntegerNode(image, 0))
        limits.set(f"{name}Maximum", libe57.IntegerNode(image, top))
    return limits
