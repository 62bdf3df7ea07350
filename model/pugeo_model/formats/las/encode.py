# SPDX-License-Identifier: Apache-2.0
"""A cloud as LAS or LAZ, by laspy."""

import datetime as dt
import math
import tempfile
import uuid
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import UntreatableCloudError
from pugeo_model.formats.las.header import LasInfo, import_laspy
from pugeo_model.formats.stream import CHUNK_BYTES

__all__ = ["encode"]

_BLOCK_ROWS = 1 << 17
_SPOOL_BYTES = 1 << 24
_FINEST = 1e-6
"""Finest step of coordinates that is chosen, cloud units."""
_STEPS = 2**31 - 1
_GRID = 1e-9
"""Largest distance of a coordinate from the input's grid, in steps of its own magnitude."""
_NORMALS = ("NormalX", "NormalY", "NormalZ")
_CHANNELS = ("red", "green", "blue")
_MOST_NAME = 32  # bytes of the name of an extra dimension
_WITH_TIME, _WITH_COLOR = {1, 3, 4, 5}, {2, 3, 5, 7, 8, 10}
_WKT_BIT = 1 << 4


def encode(cloud: Cloud, file: IO[bytes], *, compress: bool) -> None:
    """Write all points.

    A cloud from a LAS file keeps its version, point format, records (CRS among them) and source
    identifiers. Any other becomes LAS 1.4 of point format 6, or 7 with colours. Coordinates keep
    the input's scale and offset if all of them lie on that grid, else the scale is 1e-6 (the
    smallest power of ten above it where the cloud is wider than 4 km). Scalars go to the standard
    field of their name if it can hold all values, else to an extra dimension; normals to the
    extra dimensions ``NormalX``, ``NormalY``, ``NormalZ`` (float32).

    Args:
        cloud: finite points.
        file: need not be seekable.
        compress: LAZ instead of LAS.

    Raises:
        UntreatableCloudError: a point that is not finite, or coordinates beyond 1e300.
    """
    laspy = import_laspy()
    info = cloud.source.header if cloud.source is not None else None
    info = info if isinstance(info, LasInfo) else None
    header, standard, extra = _header(laspy, cloud, info)
    # The standard asks for the full range of 16 bits; a file that does not use it stays as it is.
    widen = 1 if info is not None and info.narrow_colors else 257
    # The library returns to the header once all points are written.
    with tempfile.SpooledTemporaryFile(max_size=_SPOOL_BYTES) as spool:
        with laspy.LasWriter(
            spool, header, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs, closefd=False
        ) as writer:
            for start in range(0, len(cloud), _BLOCK_ROWS):
                part = slice(start, min(start + _BLOCK_ROWS, len(cloud)))
                writer.write_points(_rows(laspy, header, cloud, part, standard, extra, widen))
        spool.seek(0)
        while data := spool.read(CHUNK_BYTES):
            file.write(data)


def _rows(
    laspy: Any,
    header: Any,
    cloud: Cloud,
    part: slice,
    standard: dict[str, str],
    extra: dict[str, NDArray[Any]],
    widen: int,
) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(part.stop - part.start, header=header)
    points = cloud.points[part].astype(np.float64)
    for index, axis in enumerate("XYZ"):
        steps = (points[:, index] - header.offsets[index]) / header.scales[index]
        record[axis] = np.rint(steps).astype(np.int32)
    for name, field in standard.items():
        record[field] = cloud.scalars[name][part]
    for name, values in extra.items():
        record[name] = values[part]
    if cloud.colors is not None:
        channels = cloud.colors[part, :3]
        if channels.dtype == np.uint8:
            channels = channels.astype(np.uint16) * np.uint16(widen)
        for index, name in enumerate(_CHANNELS):
            record[name] = channels[:, index]
    return record


def _header(
    laspy: Any, cloud: Cloud, info: LasInfo | None
) -> tuple[Any, dict[str, str], dict[str, NDArray[Any]]]:
    """The header; scalars of standard fields and their fields; extra dimensions."""
    colored = cloud.colors is not None
    if info is None:
        version, kind = "1.4", 7 if colored else 6
    else:
        version, kind = info.version, _without_waves(info.point_format, colored=colored)
        version = "1.2" if version in ("1.0", "1.1") else version
    header = laspy.LasHeader(version=version, point_format=kind)
    header.generating_software = "pugeo"
    scales, offsets = _grid(cloud.points, info)
    header.scales, header.offsets = np.array(scales), np.array(offsets)
    crs = cloud.source.crs if cloud.source is not None else None
    header.uuid = uuid.UUID(int=0)
    header.creation_date = None
    if info is not None:
        header.global_encoding.value = info.global_encoding
        header.file_source_id = info.file_source_id
        header.uuid = uuid.UUID(bytes=info.uuid)
        header.system_identifier = info.system_identifier
        if info.created is not None:
            header.creation_date = dt.date.fromordinal(info.created)
        for user, record, description, data in info.vlrs:
            header.vlrs.append(laspy.VLR(user, record, description, data))
    elif crs is not None:
        data = crs.encode() + b"\0"
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", data))
    if kind >= 6:
        # The standard asks for it: newer point formats have no other CRS.
        header.global_encoding.value |= _WKT_BIT
    standard, extra = _dimensions(cloud, header)
    parameters = [
        laspy.ExtraBytesParams(name=name, type=values.dtype) for name, values in extra.items()
    ]
    header.add_extra_dims(parameters)
    return header, standard, extra


def _without_waves(kind: int, *, colored: bool) -> int:
    """The point format without waveforms, and with colours where there are some."""
    kind = {4: 1, 5: 3, 9: 6, 10: 8}.get(kind, kind)
    return {0: 2, 1: 3, 6: 7}.get(kind, kind) if colored else kind


def _grid(
    points: NDArray[Any], info: LasInfo | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Scale and offset of each axis."""
    if not len(points):
        return (_FINEST,) * 3, (0.0,) * 3
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    if not (np.abs([low, high]) < 1e300).all():
        raise UntreatableCloudError(
            "LAS cannot hold points that are not finite.", code="not_finite"
        )
    if info is not None and _on_grid(points, info):
        return info.scales, info.offsets
    scales, offsets = [], []
    for least, most in zip(low.tolist(), high.tolist(), strict=True):
        half = (most - least) / 2 + 1.0
        scale = max(_FINEST, 10.0 ** math.ceil(math.log10(half / _STEPS)))
        scales.append(scale)
        # A whole number, so that the digits of coordinates stay readable.
        offsets.append(float(math.floor(least + (most - least) / 2)))
    return tuple(scales), tuple(offsets)


def _on_grid(points: NDArray[Any], info: LasInfo) -> bool:
    for values, scale, offset in zip(points.T, info.scales, info.offsets, strict=True):
        if not (scale > 0 and math.isfinite(scale) and math.isfinite(offset)):
            return False
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.rint((values.astype(np.float64) - offset) / scale)
            near = np.abs(steps * scale + offset - values) <= _GRID * scale + np.spacing(
                np.abs(values)
            )
        if not (near.all() and np.abs(steps).max(initial=0) <= _STEPS):
            return False
    return True


def _dimensions(cloud: Cloud, header: Any) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Scalars that a standard field holds (name -> field), and extra dimensions."""
    fields = {
        dimension.name: dimension
        for dimension in header.point_format.standard_dimensions
        if dimension.name not in ("X", "Y", "Z", *_CHANNELS)
    }
    standard: dict[str, str] = {}
    extra: dict[str, NDArray[Any]] = {}
    for name, values in cloud.scalars.items():
        field = _field_of(name, fields)
        if field is not None and field not in standard.values() and _holds(fields[field], values):
            standard[name] = field
        else:
            taken = {each.lower() for each in (*fields, *extra, *_CHANNELS, *_NORMALS, *"xyz")}
            extra[_free_name(name, taken)] = _storable(values)
    if cloud.normals is not None:
        for name, part in zip(_NORMALS, cloud.normals.T, strict=True):
            extra[name] = np.ascontiguousarray(part, np.float32)
    return standard, extra


def _field_of(name: str, fields: dict[str, Any]) -> str | None:
    """The standard field of a scalar's name: case, separators and ``scalar_`` do not count."""
    plain = "".join(c for c in name.lower().removeprefix("scalar_") if c.isalnum())
    aliases = {"class": "classification", "time": "gpstime", "numreturns": "numberofreturns"}
    plain = aliases.get(plain, plain)
    return next((field for field in fields if field.replace("_", "") == plain), None)


def _holds(field: Any, values: NDArray[Any]) -> bool:
    """True if a standard field can hold all values exactly."""
    if field.dtype is not None and field.dtype.kind == "f":
        return values.dtype.kind in "fiub"
    if values.dtype.kind == "f" and not (
        np.isfinite(values).all() and (values == np.rint(values)).all()
    ):
        return False
    low, high = values.min(initial=0), values.max(initial=0)
    return bool(field.min <= low and high <= field.max)


def _storable(values: NDArray[Any]) -> NDArray[Any]:
    """Values in a type that LAS knows."""
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        return values.astype(np.float32 if values.dtype.itemsize < 4 else np.float64)
    return np.ascontiguousarray(values)


def _free_name(name: str, taken: set[str]) -> str:
    """A name of at most 32 bytes that no other dimension has, whatever the case."""
    word = name.encode("utf-8", "replace")[:_MOST_NAME].decode("utf-8", "ignore") or "scalar"
    free, number = word, 2
    if free.lower() in taken:
        free = f"scalar_{word}".encode()[:_MOST_NAME].decode("utf-8", "ignore")
    while free.lower() in taken:
        tail = f"_{number}"
        free = word.encode()[: _MOST_NAME - len(tail)].decode("utf-8", "ignore") + tail
        number += 1
    return free
