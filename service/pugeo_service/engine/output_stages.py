# SPDX-License-Identifier: Apache-2.0
"""The last stages of a request on the workers: from dense tiles to the bytes of the answer.

Formats made of rows are written tile by tile on the worker of each tile, so that no process holds
the bytes of a large answer. The others are assembled on one worker.
"""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pugeo_service.engine.backend import quick
from pugeo_service.engine.messages import AgreementInfo, OutputInfo
from pugeo_service.engine.values import (
    Batches,
    DenseTile,
    Opaque,
    Output,
    Prepared,
    TileAgreements,
)

if TYPE_CHECKING:
    from pugeo_model.finish import Border, UpsampledTile
    from pugeo_model.plan import Plan
    from pugeo_model.stage_times import StageTimes
    from pugeo_service.storage.shared_file import SharedFile

__all__ = [
    "agree",
    "assemble",
    "border",
    "describe_agreements",
    "describe_output",
    "read_chunk",
    "write_tile",
    "written",
]

_CHUNK_BYTES = 8 << 20
_INLINE_BYTES = 1 << 16  # as many travel inside the message that announces them


@quick
def border(dense: DenseTile) -> Opaque[Border]:
    """Return everything that other tiles need to know of a tile, so that only it travels."""
    return Opaque(dense.tile.border)


def agree(prepared: Prepared, borders: Sequence[Opaque[Border]], format: str) -> TileAgreements:
    """Let the tiles of a cloud agree on signs and border points.

    Args:
        prepared: the cloud.
        borders: of its tiles, in order.
        format: of the answer.
    """
    from pugeo_model.assembly import agree as agree_on
    from pugeo_model.formats import dropped

    start = time.perf_counter()
    plan = prepared.plan
    assert plan is not None
    assert plan.noise is not None
    tiles = agree_on([known.value for known in borders])
    seconds = {"finish": time.perf_counter() - start}
    report = _with_note(plan.final_report(plan.noise), dropped(plan.cloud, format))
    return TileAgreements(tiles, plan.n_out, format, report, seconds)


@quick
def describe_agreements(agreements: TileAgreements) -> AgreementInfo:
    """Describe the agreements to the front."""
    return AgreementInfo(agreements.report, agreements.seconds)


def write_tile(dense: DenseTile, agreements: TileAgreements, number: int) -> Output:
    """Write a tile as rows of the answer; tile 0 begins with the header of the file."""
    import numpy as np

    from pugeo_model import formats
    from pugeo_model.assembly import apply_agreement

    start = time.perf_counter()
    cloud = apply_agreement(dense.tile, agreements.tiles[number])
    module = formats.BY_ROWS[agreements.format]
    buffer = io.BytesIO()
    if number == 0:
        buffer.write(module.head(cloud, agreements.count))
    for block in module.rows(cloud):
        buffer.write(block)
    data = np.frombuffer(buffer.getbuffer(), np.uint8)
    return Output(data, agreements.report, {"write": time.perf_counter() - start})


def assemble(prepared: Prepared, tiles: Sequence[DenseTile], format: str) -> Output:
    """Join the tiles of a cloud, in order, and write it in a format."""
    from pugeo_model.stage_times import StageTimes

    assert prepared.plan is not None
    return written(prepared.plan, [dense.tile for dense in tiles], format, StageTimes(), [])


def written(
    plan: Plan,
    tiles: Sequence[UpsampledTile],
    format: str,
    times: StageTimes,
    batches: Batches,
) -> Output:
    """Join tiles and write them; the output reports ``times`` and ``batches``."""
    import numpy as np

    from pugeo_model import formats
    from pugeo_model.assembly import assemble as join

    with times.measure("finish"):
        result = join(plan, tiles)
    with times.measure("write"):
        buffer = io.BytesIO()
        formats.write(result.cloud, buffer, format=format)
        data = np.frombuffer(buffer.getbuffer(), np.uint8)
    report = _with_note(result.report, formats.dropped(result.cloud, format))
    return Output(data, report, times.seconds, batches)


def _with_note(report: dict[str, Any], note: str | None) -> dict[str, Any]:
    """Add a note to those of a report, if there is one."""
    return report if note is None else {**report, "notes": [*report["notes"], note]}


@quick
def describe_output(output: Output, file: SharedFile | None) -> OutputInfo:
    """Describe some bytes to the front, and bring their beginning.

    Args:
        output: the bytes.
        file: file of the front for the first bytes; ``None`` if other bytes precede them.
    """
    first = b"" if file is None else read_chunk(output, 0, file, 0)
    return OutputInfo(len(output.data), first, output.report, output.seconds, output.batches)


@quick
def read_chunk(source: Output | Prepared, start: int, file: SharedFile, offset: int) -> bytes | int:
    """Bring a part of the answer to the front, from byte ``start`` of it on.

    Args:
        source: the answer, or a cloud that was upsampled when it was read.
        start: first byte.
        file: of the front.
        offset: bytes of the answer that the file has already.

    Returns:
        The number of bytes that were written to the file, or the bytes themselves if they are few
        or the file is on another machine.
    """
    output = source.output if isinstance(source, Prepared) else source
    assert output is not None
    data = output.data[start : start + _CHUNK_BYTES]
    if len(data) > _INLINE_BYTES and file.put(data, offset):
        return len(data)
    return data.tobytes()
