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
from pugeo_service.engine.order import Sheet
from pugeo_service.engine.values import Agreed, Carried, Finished, Prepared, Written

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


def describe_finished(finished: Finished) -> float:
    """Return the seconds that finishing a tile took."""
    return finished.seconds


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


def describe_written(written: Written) -> Sheet:
    """Return what the front needs to know of some bytes, and the first chunk of them."""
    chunks = -(-len(written.data) // _CHUNK_BYTES)
    return Sheet(chunks, chunk(written, 0), written.report, written.seconds)


def chunk(written: Written, index: int) -> bytes:
    """Return a part of the answer small enough for the front's memory."""
    return written.data[index * _CHUNK_BYTES : (index + 1) * _CHUNK_BYTES].tobytes()
