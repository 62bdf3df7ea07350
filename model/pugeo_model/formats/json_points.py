# SPDX-License-Identifier: Apache-2.0
"""JSON: ``{"points": [[x, y, z], ...], "normals": ..., "colors": ..., "scalars": {...}}``."""

import re
from collections.abc import Iterator
from typing import IO, Annotated, Any, TypeVar

import msgspec
import numpy as np
import orjson
from numpy.typing import NDArray

from pugeo_model.cloud import Cloud
from pugeo_model.errors import MalformedFileError
from pugeo_model.formats.colors import to_channels
from pugeo_model.formats.limits import Limits

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "NAME", "encode", "read", "sniff", "write"]

NAME = "json"
EXTENSIONS: tuple[str, ...] = (".json",)
MEDIA_TYPES: tuple[str, ...] = ("application/json",)

_BLOCK_ROWS = 16_384
# Python's json writes these, though JSON has no such values.
_NOT_FINITE = re.compile(rb"(?<=[\[,])\s{0,9}-?(?:NaN|Infinity)(?=\s{0,9}[\],])")
_MAX_SCALARS = 256

_Row = tuple[float | None, float | None, float | None]
_Color = Annotated[list[int | float], msgspec.Meta(min_length=3, max_length=4)]
_Scalar = list[bool | int | float | None]


class _Document(msgspec.Struct, forbid_unknown_fields=True):
    """The document's keys; their values are counted before they are decoded."""

    points: msgspec.Raw
    normals: msgspec.Raw = msgspec.Raw(b"null")
    colors: msgspec.Raw = msgspec.Raw(b"null")
    scalars: dict[str, msgspec.Raw] | None = None


_documents = msgspec.json.Decoder(_Document)
_triples = msgspec.json.Decoder(list[_Row])
_colors = msgspec.json.Decoder(list[_Color])
_scalars = msgspec.json.Decoder(_Scalar)
_Item = TypeVar("_Item")


def sniff(head: bytes) -> bool:
    """True if a file with these first bytes is a JSON object."""
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def read(file: IO[bytes], limits: Limits) -> Cloud:
    """Read a cloud; points become float64.

    Colours are 0..1 where any of them has a decimal point, else 0..255, or 0..65535 where one
    exceeds 255. A scalar of whole numbers is a label, of true and false a mask. ``null``, and NaN
    and Infinity as Python writes them, are missing values: NaN.

    A decoded row takes some 150 bytes before it becomes part of an array; rows are counted
    before they are decoded.

    Args:
        file: at the first byte.
        limits: ``max_points`` bounds the rows.

    Raises:
        MalformedFileError: not JSON, an unknown key, a row that is not three numbers, lists
            of different lengths. The message has the place, such as ``$.points[17]``.
        LimitExceededError: more points than ``limits``.
    """
    text = file.read().removeprefix(b"\xef\xbb\xbf")
    if _NOT_FINITE.search(text):
        text = _NOT_FINITE.sub(b"null", text)
    try:
        document = _documents.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _bad(
            f"The JSON cannot be read: {error}. Allowed keys are points (required), normals, "
            "colors and scalars."
        ) from error
    rows = _decode("points", document.points, _triples, limits)
    points = np.array(rows, np.float64).reshape(-1, 3)
    count = len(points)
    normals: NDArray[np.float32] | None = None
    if not _is_null(document.normals):
        rows = _decode("normals", document.normals, _triples, limits)
        _check_length("normals", len(rows), count)
        with np.errstate(over="ignore"):
            normals = np.array(rows, np.float64).reshape(-1, 3).astype(np.float32)
    del rows
    colors: NDArray[Any] | None = None
    if not _is_null(document.colors):
        channels = _decode("colors", document.colors, _colors, limits)
        _check_length("colors", len(channels), count)
        colors = _to_colors(channels)
    scalars = document.scalars or {}
    if len(scalars) > _MAX_SCALARS:
        raise _bad(f"'scalars' has {len(scalars):,} keys, at most {_MAX_SCALARS} are read.")
    arrays = {name: _to_scalar(name, raw, count, limits) for name, raw in scalars.items()}
    return Cloud(points, normals, colors, arrays)


def encode(cloud: Cloud) -> Iterator[bytes]:
    """Yield a document, some thousand rows at a time; values that are not finite are ``null``."""
    yield b'{"points":'
    yield from _array(cloud.points)
    if cloud.normals is not None:
        yield b',"normals":'
        yield from _array(cloud.normals)
    if cloud.colors is not None:
        yield b',"colors":'
        yield from _array(cloud.colors)
    if cloud.scalars:
        opening = b',"scalars":{'
        for name, values in cloud.scalars.items():
            yield opening + orjson.dumps(name) + b":"
            yield from _array(values)
            opening = b","
        yield b"}"
    yield b"}"


def write(cloud: Cloud, file: IO[bytes]) -> None:
    """Write a document, with digits enough to read the same numbers back."""
    for block in encode(cloud):
        file.write(block)


def _array(values: NDArray[Any]) -> Iterator[bytes]:
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        values = values.astype(np.float32 if values.dtype.itemsize < 4 else np.float64)
    opening = b"["
    for start in range(0, len(values), _BLOCK_ROWS):
        block = np.ascontiguousarray(values[start : start + _BLOCK_ROWS])
        yield opening + orjson.dumps(block, option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        opening = b","
    yield b"]" if len(values) else b"[]"


def _is_null(raw: msgspec.Raw) -> bool:
    return bytes(memoryview(raw)[:4]) == b"null"


def _decode(
    key: str, raw: msgspec.Raw, decoder: msgspec.json.Decoder[_Item], limits: Limits
) -> _Item:
    """Decode the value of a key, after counting its rows (numbers, for a scalar)."""
    data = np.frombuffer(raw, np.uint8)
    mark, others = (b",", 1) if decoder is _scalars else (b"[", -1)
    rows = int(np.count_nonzero(data == mark[0])) + others
    limits.check("max_points", rows, f"Rows of {key!r}")
    try:
        return decoder.decode(raw)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        where = str(error).replace("`$", f"`$.{key}")
        raise _bad(f"'{key}' cannot be read: {where}.", key=key) from error


def _check_length(key: str, found: int, count: int) -> None:
    if found != count:
        raise _bad(f"'{key}' has {found:,} rows, but 'points' has {count:,}.", key=key)


def _to_colors(rows: list[list[int | float]]) -> NDArray[Any]:
    width = len(rows[0]) if rows else 3
    for index, row in enumerate(rows):
        if len(row) != width:
            raise _bad(
                f"$.colors[{index}] has {len(row)} numbers, the rows before it have {width}.",
                key="colors",
                row=index,
            )
    values = np.array(rows).reshape(-1, width)
    if values.dtype.kind != "f":
        beyond = np.flatnonzero(((values < 0) | (values > 65535)).any(axis=1))
        if len(beyond):
            index = int(beyond[0])
            raise _bad(
                f"$.colors[{index}]: whole numbers must be in 0..255, or in 0..65535 of 16 bits.",
                key="colors",
                row=index,
            )
        values = values.astype(np.uint16 if values.max(initial=0) > 255 else np.uint8)
    return to_channels(values)[0]


def _to_scalar(name: str, raw: msgspec.Raw, count: int, limits: Limits) -> NDArray[Any]:
    key = f"scalars.{name}"
    items = _decode(key, raw, _scalars, limits)
    _check_length(key, len(items), count)
    if not items:
        return np.empty(0)
    try:
        values = np.array(items, _number_type(items))
    except OverflowError:
        values = np.empty(0, object)
    if values.dtype.kind not in "fiub":
        raise _bad(f"$.{key}: a whole number is beyond 64 bits.", key=key)
    return values


def _number_type(items: list[Any]) -> type[np.generic] | None:
    """Return the type of some numbers where numpy's own choice would round them."""
    if None in items:
        return np.float64
    # Numbers on both sides of 2^63 would become doubles.
    if all(type(item) is int for item in items) and 0 <= min(items) < 2**63 <= max(items):
        return np.uint64
    return None


def _bad(message: str, **fields: Any) -> MalformedFileError:
    return MalformedFileError(message, code="bad_json", **fields)
