# SPDX-License-Identifier: Apache-2.0
"""LAS and LAZ points as a cloud, by laspy."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud, SourceInfo
from pugeo_model.errors import CloudError, MalformedFileError
from pugeo_model.formats.colors import to_channels
from pugeo_model.formats.las.header import LasInfo, check, import_laspy
from pugeo_model.formats.limits import Declared, Limits
from pugeo_model.formats.stream import bytes_left

__all__ = ["declared", "read"]

_BLOCK_ROWS, _BLOCK_BYTES = 1 << 16, 1 << 24
_SPOOL_BYTES = 1 << 24
_CHANNELS = ("red", "green", "blue")
_NORMALS = ("normalx", "normaly", "normalz")
_WAVES = frozenset(
    ["wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location"]
    + ["x_t", "y_t", "z_t"]
)
_OWN_RECORDS = frozenset([("LASF_Spec", 4), ("laszip encoded", 22204), ("copc", 1)])
"""Records that describe the file's own rows, so that the writer makes new ones."""
_WKT = ("LASF_Projection", 2112)


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read the points of a LAS or LAZ file; points become float64.

    Colours stay 16-bit, or become 8-bit where none exceeds 255. Extra dimensions are scalars, and
    ``NormalX``, ``NormalY``, ``NormalZ`` among them normals. Standard fields keep the names that
    laspy gives them; those that are zero everywhere are left out, apart from the classification.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` and ``max_bytes`` are checked against the header.

    Raises:
        MalformedFileError: not LAS, truncated, or broken compressed data.
        LimitExceededError: larger than ``limits``.
        UnsupportedFormatError: laspy is not installed.
    """
    laspy = import_laspy()
    with _from_zero(file) as source, _as_malformed():
        check(source, bytes_left(source), limits)
        backend = laspy.LazBackend.Lazrs
        with laspy.open(source, closefd=False, laz_backend=backend, read_evlrs=False) as reader:
            header = reader.header
            extended = header.number_of_evlrs if str(header.version) == "1.4" else 0
            rows = max(1, min(_BLOCK_ROWS, _BLOCK_BYTES // header.point_format.size))
            blocks = [_columns(block) for block in reader.chunk_iterator(rows)]
            found = sum(len(block["x"]) for block in blocks)
            if found != header.point_count:
                raise MalformedFileError(
                    f"The LAS file declares {header.point_count:,} points, found {found:,}.",
                    code="truncated",
                    expected_rows=header.point_count,
                    found_rows=found,
                )
            info, crs = _info(header), _crs(header)
            standard = set(header.point_format.standard_dimension_names)
    columns = {name: np.concatenate([b[name] for b in blocks]) for name in (blocks or [{}])[0]}
    fields = [name for name in columns if name in standard and name not in _CHANNELS]
    return _cloud(columns, fields, SourceInfo("las", crs, info), extended)


def declared(file: IO[bytes], limits: Limits) -> Declared:
    """Return the size of a cloud as the header states it.

    Args:
        file: seekable, at the first byte.
        limits: ``max_points`` and ``max_bytes`` are checked.

    Raises:
        MalformedFileError, LimitExceededError: as `read`.
    """
    with _from_zero(file) as source:
        return check(source, bytes_left(source), limits)


@contextmanager
def _from_zero(file: IO[bytes]) -> Iterator[IO[bytes]]:
    """Give a file whose first byte is the cloud's: offsets in LAS count from there."""
    if file.tell() == 0:
        yield file
        return
    with tempfile.SpooledTemporaryFile(max_size=_SPOOL_BYTES) as spool:
        shutil.copyfileobj(file, spool)
        spool.seek(0)
        yield spool


@contextmanager
def _as_malformed() -> Iterator[None]:
    """Turn the errors of laspy and lazrs about broken bytes into one."""
    try:
        yield
    except CloudError:
        raise
    except MemoryError as error:
        raise _broken(error) from error
    except Exception as error:
        raise _broken(error) from error
    except BaseException as error:
        # A panic of the Rust library; other errors of this kind (Ctrl-C) pass.
        if type(error).__name__ != "PanicException":
            raise
        raise _broken(error) from error


def _broken(error: BaseException) -> MalformedFileError:
    reason = (str(error) or type(error).__name__)[:200]
    return MalformedFileError(f"The LAS file cannot be read: {reason}.", code="bad_row")


def _columns(block: Any) -> dict[str, NDArray[Any]]:
    """All dimensions of some points; coordinates scaled, in float64."""
    found = {axis: np.asarray(block[axis], np.float64) for axis in "xyz"}
    for name in block.point_format.dimension_names:
        if name in ("X", "Y", "Z") or name in _WAVES:
            continue
        values = np.asarray(block[name])
        if values.ndim == 1:
            found[name] = np.ascontiguousarray(values)
        else:
            for index, part in enumerate(values.T):
                found[f"{name}_{index}"] = np.ascontiguousarray(part)
    return found


def _cloud(
    columns: dict[str, NDArray[Any]], fields: list[str], source: SourceInfo, extended: int
) -> Cloud:
    """Build the cloud; ``fields`` are the standard dimensions among the columns."""
    notes: list[str] = []
    if extended:
        notes.append(f"{extended:,} extended records after the points are dropped.")
    if source.header.point_format in (4, 5, 9, 10):
        notes.append("Waveforms are dropped.")
    points = np.empty((0, 3))
    if columns:
        points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
    colors: NDArray[Any] | None = None
    if all(name in columns for name in _CHANNELS):
        colors, note = to_channels(np.stack([columns.pop(n) for n in _CHANNELS], axis=1))
        if colors.dtype == np.uint16 and not (colors % np.uint16(257)).any():
            # 65535 / 255 = 257: colours of 8 bits, spread over the range as the standard asks.
            colors = (colors // np.uint16(257)).astype(np.uint8)
        if note is not None:
            notes.append(note)
            source = replace(source, header=replace(source.header, narrow_colors=True))
    lowered = {name.lower(): name for name in columns}
    normals: NDArray[np.float32] | None = None
    if all(name in lowered for name in _NORMALS):
        parts = [columns.pop(lowered[name]) for name in _NORMALS]
        with np.errstate(over="ignore", invalid="ignore"):
            normals = np.stack(parts, axis=1).astype(np.float32)
    # A file without a field is the same as one with zeros; classes are kept, since 0 is one.
    with np.errstate(invalid="ignore"):  # signalling NaN, which broken files have
        zero = [name for name in fields if name != "classification" and not columns[name].any()]
    scalars = {
        name: values
        for name, values in columns.items()
        if name not in zero and values.dtype.kind in "fiub"
    }
    return Cloud(points, normals, colors, scalars, tuple(notes), source=source)


def _info(header: Any) -> LasInfo:
    records = tuple(
        (record.user_id, int(record.record_id), record.description, record.record_data_bytes())
        for record in header.vlrs
        if (record.user_id, record.record_id) not in _OWN_RECORDS
    )
    return LasInfo(
        version=str(header.version),
        point_format=int(header.point_format.id),
        scales=(float(header.scales[0]), float(header.scales[1]), float(header.scales[2])),
        offsets=(float(header.offsets[0]), float(header.offsets[1]), float(header.offsets[2])),
        vlrs=records,
        global_encoding=int(header.global_encoding.value),
        file_source_id=int(header.file_source_id),
        uuid=header.uuid.bytes,
        system_identifier=str(header.system_identifier),
        created=None if header.creation_date is None else header.creation_date.toordinal(),
    )


def _crs(header: Any) -> str | None:
    for record in header.vlrs:
        if (record.user_id, record.record_id) == _WKT:
            text = record.record_data_bytes().split(b"\0")[0].decode("utf-8", "replace")
            return text or None
    return None
