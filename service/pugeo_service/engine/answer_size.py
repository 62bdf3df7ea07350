# SPDX-License-Identifier: Apache-2.0
"""Bounds on the size of an answer and on the memory of its making, checked before the work."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pugeo_model.errors import LimitExceededError
from pugeo_service.engine.messages import RunRequest

if TYPE_CHECKING:
    from pugeo_model.cloud import Cloud
    from pugeo_model.formats import Declared
    from pugeo_model.options import Options
    from pugeo_model.plan import Plan

__all__ = ["check_answer", "check_plan"]

_NORMAL_BYTES = 12
_SCALAR_BYTES = 4
# A worker with the model takes 0.6 GB. For 122 MB of answer (2,000 points, 1,000 scalars, R=8,
# as PLY) it takes 352 MB more, 2.9 times: columns of the tile and of the cloud, and their bytes.
_WORKER_BYTES = 600 << 20
_COPIES = 4
# Of an answer that is written tile by tile, a worker holds the tiles that it has finished.
_PARTS = 4
# Dask pauses a worker at 80 % of its memory.
_USABLE = 0.8
# A worker that is ready has room for so many, whatever the estimate says.
_LEAST_BYTES = 32 << 20


def check_answer(size: Declared, options: Options, request: RunRequest) -> None:
    """Refuse an answer with too many points or bytes, as far as options and input decide on them.

    Args:
        size: of the input, by its header or as it was read.
        options: decide on the number of points of the answer; with ``spacing`` the plan does.
        request: has the bounds.

    Raises:
        LimitExceededError: it would exceed ``max_output_points`` or ``max_output_bytes``.
    """
    points = options.points_out(size.points)
    if points is not None:
        _check(points, _row_bytes(size, options), request, "Lower R")


def check_plan(plan: Plan, request: RunRequest, *, in_parts: bool) -> None:
    """Refuse an answer that is too large, or that no worker has the memory to make.

    Args:
        plan: of the run.
        request: has the bounds and the memory of a worker.
        in_parts: the answer is written tile by tile.

    Raises:
        LimitExceededError: it would exceed a bound.
    """
    change = "Lower R" if plan.options.spacing is None else "Ask for a wider spacing"
    _check(plan.n_out, _row_bytes(plan.cloud, plan.options), request, change)
    _check_memory(plan, request, change, in_parts=in_parts)


def _row_bytes(size: Declared | Cloud, options: Options) -> int:
    """Bytes of a point of the answer, with its normal."""
    return size.row_bytes + _NORMAL_BYTES + (_SCALAR_BYTES if options.confidence else 0)


def _check(points: int, row: int, request: RunRequest, change: str) -> None:
    if points > request.max_output_points:
        raise LimitExceededError(
            f"The answer would have {points:,} points; the limit is "
            f"{request.max_output_points:,}. {change}.",
            code="too_many_output_points",
            name="max_output_points",
            limit=request.max_output_points,
            value=points,
        )
    if points * row > request.max_output_bytes:
        raise LimitExceededError(
            f"The answer would have {points * row:,} bytes, {points:,} points of {row:,}; the "
            f"limit is {request.max_output_bytes:,}. {change}, or send fewer attributes.",
            code="too_many_output_bytes",
            name="max_output_bytes",
            limit=request.max_output_bytes,
            value=points * row,
        )


def _check_memory(plan: Plan, request: RunRequest, change: str, *, in_parts: bool) -> None:
    if request.worker_bytes is None:
        return
    row = _row_bytes(plan.cloud, plan.options)
    answer = plan.n_out * row
    held = answer // min(_PARTS, len(plan.tile_specs)) if in_parts else answer
    spare = int(_USABLE * request.worker_bytes) - _WORKER_BYTES
    limit = max(_LEAST_BYTES, spare // _COPIES)
    if held > limit:
        raise LimitExceededError(
            f"The answer of {plan.n_out:,} points of {row:,} bytes has {held:,} bytes to hold at "
            f"one time; a worker of {request.worker_bytes:,} bytes has room for {limit:,}. "
            f"{change}, or send fewer attributes.",
            code="too_much_memory",
            name="worker_memory",
            limit=limit,
            value=held,
        )
