# SPDX-License-Identifier: Apache-2.0
"""The last steps of a request on the workers: from dense tiles to the bytes of the answer.

Formats whose rows follow each other are written tile by tile where the tile is: nobody ever holds
the bytes of the whole answer. The others are put together on one worker.
"""

import io
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from pugeo_model import formats, pipeline
from pugeo_service.engine.messages import Sheet
from pugeo_service.engine.values import Agreed, Carried, Finished, Prepared, Written
from pugeo_service.storage.shared_file import SharedFile

__all__ = [
    "agree",
    "assemble",
    "at_once",
    "border",
    "chunk",
    "describe_agreed",
    "describe_finished",
    "describe_written",
    "write_tile",
]

_CHUNK_BYTES = 8 << 20
_FEW_BYTES = 1 << 16  # so many cross in the message that says that they are there


def describe_finished(finished: Finished) -> tuple[dict[str, float], list[tuple[float, int]]]:
    """Return the seconds of each stage of a tile since the network, and each batch's own."""
    return finished.seconds, finished.batches


def border(finished: Finished) -> Carried:
    """Return what a tile has to tell the others: little, so that only it travels."""
    return Carried(finished.piece.border)


def agree(prepared: Prepared, known: Sequence[Carried], answer: str) -> Agreed:
    """Let the tiles agree on their borders; ``known`` is what each of them says."""
    start = time.perf_counter()
    plan = prepared.plan
    tiles = pipeline.agree([said.value for said in known])
    seconds = time.perf_counter() - start
    return Agreed(tiles, plan.n_out, answer, plan.told(plan.noise), seconds)


def describe_agreed(agreed: Agreed) -> tuple[dict[str, Any], float]:
    """Return the report of the run, and the seconds that agreeing took."""
    return agreed.report, agreed.seconds


def write_tile(finished: Finished, agreed: Agreed, number: int) -> Written:
    """Return the part of the answer that a tile is; that of the first with what precedes rows."""
    start = time.perf_counter()
    cloud = pipeline.settle(finished.piece, agreed.tiles[number])
    module = formats.BY_ROWS[agreed.answer]
    buffer = io.BytesIO()
    if number == 0:
        buffer.write(module.head(cloud, agreed.count))
    for block in module.rows(cloud):
        buffer.write(block)
    data = np.frombuffer(buffer.getbuffer(), np.uint8)
    return Written(data, agreed.report, {"write": time.perf_counter() - start})


def assemble(prepared: Prepared, parts: Sequence[Finished], answer: str) -> Written:
    """Put the tiles of a cloud together and write it in the format ``answer``."""
    start = time.perf_counter()
    result = pipeline.assemble(prepared.plan, [part.piece for part in parts])
    finished = time.perf_counter()
    buffer = io.BytesIO()
    formats.write(result.cloud, buffer, format=answer)
    seconds = {"finish": finished - start, "write": time.perf_counter() - finished}
    data = np.frombuffer(buffer.getbuffer(), np.uint8)
    return Written(data, result.report, seconds)


def at_once(prepared: Prepared) -> Written:
    """Return the answer of a cloud that was done when it was read."""
    assert prepared.written is not None
    return prepared.written


def describe_written(written: Written, file: SharedFile | None) -> Sheet:
    """Return what the front needs to know of some bytes, with their beginning.

    Args:
        written: the bytes.
        file: of the front, where the beginning goes; ``None`` where others come before it.
    """
    first = b"" if file is None else chunk(written, 0, file, 0)
    return Sheet(len(written.data), first, written.report, written.seconds, written.batches)


def chunk(written: Written, start: int, file: SharedFile, offset: int) -> bytes | int:
    """Bring a part of the answer, from byte ``start`` of it on, to the front.

    Returns:
        How many bytes were put into the front's file, behind its first ``offset``, or the bytes
        where that is not worth it or cannot be done from here.
    """
    data = written.data[start : start + _CHUNK_BYTES]
    if len(data) > _FEW_BYTES and file.put(data, offset):
        return len(data)
    return data.tobytes()
