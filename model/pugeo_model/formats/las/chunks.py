# SPDX-License-Identifier: Apache-2.0
"""Sizes that a LAZ file declares, compared with the file: lazrs allocates whatever they say.

The record "laszip encoded" 22204 lists the items of a point. Compressed points lie in chunks, and
those of point formats 6 to 10 (compressor 3, layered) begin with their first point as it is, the
number of points (4 bytes), and the size of each layer (4 bytes each), which the layers follow. The
layout is that of M. Isenburg, LASzip.
"""

import struct
from typing import IO

from pugeo_model.errors import MalformedFileError

__all__ = ["check_chunks"]

_RECORD = struct.Struct("<2x16sHH32x")
_ITEMS_AT = 32  # byte of the record's data where the number of items stands
_LAYERED = 3
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES = 14  # an item with one layer for each byte
_ANY_SIZE = (1 << 32) - 1  # size of chunks of which each has its own
_PLAIN = (0, 6, 7, 8, 9)  # items of the other compressors


def check_chunks(file: IO[bytes], header: tuple[int, int, int], size: int, points: int) -> None:
    """Check items, chunk table and layers of a LAZ file.

    Args:
        file: its position moves.
        header: bytes of the header, number of records, and byte where points begin.
        size: bytes of the file.
        points: declared number of points.

    Raises:
        MalformedFileError: a number that cannot be.
    """
    _, _, start = header
    compressor, chunk_size, items = _items(file, header)
    place = _table_place(file, start, size)
    file.seek(place + 4)
    chunks = int.from_bytes(file.read(4), "little")
    # Chunks of any size have their sizes in the table; others hold as many points as they can.
    full = points if chunk_size == _ANY_SIZE else -(-points // max(chunk_size, 1))
    least = min(points, 1) if chunk_size == _ANY_SIZE else full
    if not least <= chunks <= max(full, 1):
        raise _bad(f"{chunks:,} chunks cannot hold {points:,} points")
    if compressor == _LAYERED:
        _walk(file, items, start + 8, place, chunks)


def _items(file: IO[bytes], header: tuple[int, int, int]) -> tuple[int, int, list[tuple[int, int]]]:
    """Compressor, points of a chunk, and type and size of each item of a point."""
    at, records, start = header
    for _ in range(records):
        file.seek(at)
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size or at + _RECORD.size > start:
            break
        user, number, length = _RECORD.unpack(head)
        if user.rstrip(b"\0") == b"laszip encoded" and number == 22204:
            return _parse(file.read(length))
        at += _RECORD.size + length
    raise _bad("the record of the compression is missing")


def _parse(data: bytes) -> tuple[int, int, list[tuple[int, int]]]:
    if len(data) < _ITEMS_AT + 2:
        raise _bad("the record of the compression is too short")
    compressor = int.from_bytes(data[:2], "little")
    (count,) = struct.unpack_from("<H", data, _ITEMS_AT)
    if not 0 < count <= (len(data) - _ITEMS_AT - 2) // 6:
        raise _bad(f"the record of the compression has no room for {count:,} items")
    items = [struct.unpack_from("<HH", data, _ITEMS_AT + 2 + 6 * i) for i in range(count)]
    known = {*_LAYERS, _EXTRA_BYTES} if compressor == _LAYERED else {*_PLAIN}
    if any(kind not in known for kind, _ in items):
        raise _bad("an item of the compression is unknown")
    chunk_size = int.from_bytes(data[12:16], "little")
    return compressor, chunk_size, [(int(kind), int(size)) for kind, size in items]


def _table_place(file: IO[bytes], start: int, size: int) -> int:
    """Byte of the table of chunks."""
    file.seek(start)
    place = int.from_bytes(file.read(8), "little", signed=True)
    if place == -1:
        # Written to a stream: the place stands at the end.
        file.seek(size - 8)
        place = int.from_bytes(file.read(8), "little", signed=True)
    if not start + 8 <= place <= size - 8:
        raise MalformedFileError(
            f"The LAZ file ends too early: its table of chunks should be at byte {place:,}, but it "
            f"has {size:,} bytes.",
            code="truncated",
            expected_bytes=place,
            found_bytes=size,
        )
    return place


def _walk(file: IO[bytes], items: list[tuple[int, int]], at: int, end: int, chunks: int) -> None:
    """Go from chunk to chunk by the sizes of their layers."""
    layers = sum(size if kind == _EXTRA_BYTES else _LAYERS[kind] for kind, size in items)
    raw = sum(size for _, size in items)
    for _ in range(chunks):
        file.seek(at + raw)
        sizes = file.read(4 + 4 * layers)
        if len(sizes) == 4 + 4 * layers:
            at += raw + len(sizes) + sum(struct.unpack(f"<{layers}I", sizes[4:]))
        if len(sizes) < 4 + 4 * layers or at > end:
            raise _bad("the layers of a chunk are larger than the file")


def _bad(problem: str) -> MalformedFileError:
    return MalformedFileError(f"LAZ file: {problem}.", code="bad_header")
