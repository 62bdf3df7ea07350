# SPDX-License-Identifier: Apache-2.0
"""The stages of a request as functions that run in a worker process.

Results stay on the workers; only descriptions of them and the bytes of answers travel to the
front. The front refers to these functions without loading the model: each imports it when it runs.
"""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pugeo_service.engine.answer_size import check_answer, check_plan
from pugeo_service.engine.backend import quick
from pugeo_service.engine.messages import DenseInfo, ModelId, PreparedInfo, RunRequest
from pugeo_service.engine.model_store import load_model
from pugeo_service.engine.output_stages import describe_output, written
from pugeo_service.engine.surface_stage import make_surface
from pugeo_service.engine.values import (
    Batches,
    DenseTile,
    Opaque,
    PatchBatch,
    PredictedBatch,
    Prepared,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pugeo_model.local_stages import Predicted
    from pugeo_model.plan import Plan
    from pugeo_model.tiles import Tile
    from pugeo_service.storage.shared_file import SharedFile

__all__ = [
    "denoise",
    "densify",
    "describe_dense",
    "describe_prepared",
    "predict",
    "predict_in_place",
    "prepare",
    "prepare_tile",
    "take_patches",
    "take_tile",
]


def prepare(body: NDArray[np.uint8], request: RunRequest) -> Prepared:
    """Read the bytes of a body, uint8 ``(size,)``, and plan the run.

    A cloud of one tile is also prepared, and upsampled if it is small enough for one task. A
    surface is made here.

    Raises:
        CloudError: the input or an option cannot be used.
    """
    from pugeo_model import formats
    from pugeo_model.formats.limits import Limits
    from pugeo_model.options import Options
    from pugeo_model.plan import make_plan
    from pugeo_model.prepare import prepare as prepare_tile_of
    from pugeo_model.stage_times import StageTimes

    times = StageTimes()
    with times.measure("read"):
        options = Options(**request.options)
        limits = Limits(max_points=request.max_points, max_bytes=request.max_cloud_bytes)
        file = io.BytesIO(body.data)
        # By the header, before anything is unpacked, and by the points, which text states nowhere.
        declared = formats.declared(file, format=request.format, limits=limits)
        if declared is not None:
            check_answer(declared, options, request)
        cloud = formats.read(file, format=request.format, limits=limits)
        size = formats.Declared(len(cloud), cloud.row_bytes)
        size.check(limits)
        check_answer(size, options, request)
    if request.surface_points is not None:
        return make_surface(cloud, request.surface_points, load_model(request.model), times)
    with times.measure("prepare"):
        plan = make_plan(cloud, options, patch_ratio=load_model(request.model).patch_ratio)
    by_rows = plan.tiles_in_order and formats.by_rows(plan.cloud, request.answer)
    check_plan(plan, request, in_parts=by_rows and len(plan.tile_specs) > 1)
    if len(plan.tile_specs) > 1:
        return Prepared(plan, None, times.seconds, by_rows)
    if plan.report["patches"] <= request.one_task_patches:
        return _in_one_task(plan, request, times.seconds)
    with times.measure("prepare"):
        tile = prepare_tile_of(plan.tile(0))
    return Prepared(plan, tile, times.seconds, by_rows)


def _in_one_task(plan: Plan, request: RunRequest, seconds: dict[str, float]) -> Prepared:
    """Upsample a small cloud here: to pass it on would take longer, or gain nothing."""
    from pugeo_model.local_stages import LocalStages
    from pugeo_model.pipeline import run_here, upsample_tile

    stages = LocalStages(load_model(request.model), lambda _stage, _share: None)
    stages.times.add(seconds)
    tile = run_here(upsample_tile(stages, plan.tile(0)))
    output = written(plan, [tile], request.answer, stages.times, stages.batches)
    return Prepared(plan, None, {}, output=output)


@quick
def describe_prepared(prepared: Prepared, file: SharedFile | None = None) -> PreparedInfo:
    """Describe a planned cloud or a prepared tile to the front.

    Args:
        prepared: the cloud or tile.
        file: of the front, for the answer if it is there already; ``None`` of a tile.
    """
    from pugeo_model.denoise import needs_denoising

    plan, tile = prepared.plan, prepared.tile
    output = None if prepared.output is None else describe_output(prepared.output, file)
    if tile is not None:
        patches, tiles = len(tile.patches), 1
    else:
        assert plan is not None
        patches, tiles = plan.report["patches"], len(plan.tile_specs)
    noisy = tile is not None and needs_denoising(tile)
    return PreparedInfo(patches, tiles, prepared.seconds, prepared.by_rows, output, noisy)


@quick
def take_tile(prepared: Prepared, number: int) -> Opaque[Tile]:
    """Return one tile, so that only it travels to the worker that prepares it."""
    assert prepared.plan is not None
    return Opaque(prepared.plan.tile(number))


def prepare_tile(tile: Opaque[Tile]) -> Prepared:
    """Find neighbours, fit canonical frames, cut patches."""
    from pugeo_model.prepare import prepare as prepare_tile_of

    start = time.perf_counter()
    prepared = prepare_tile_of(tile.value)
    return Prepared(None, prepared, {"prepare": time.perf_counter() - start})


@quick
def take_patches(prepared: Prepared, start: int, stop: int) -> PatchBatch:
    """Return some patches, so that only they travel to the worker that predicts them."""
    tile = prepared.tile
    assert tile is not None
    return PatchBatch(tile.patches[start:stop], tile.candidates)


def predict(batch: PatchBatch, model: ModelId) -> PredictedBatch:
    """Run patches through the network."""
    from pugeo_model.local_stages import predict as predict_patch

    start = time.perf_counter()
    network = load_model(model)
    charts = [predict_patch(network, patch, batch.candidates) for patch in batch.patches]
    return PredictedBatch(charts, time.perf_counter() - start)


def predict_in_place(prepared: Prepared, start: int, stop: int, model: ModelId) -> PredictedBatch:
    """Run patches through the network on the worker that has their tile."""
    return predict(take_patches(prepared, start, stop), model)


def denoise(
    prepared: Prepared, batches: Sequence[PredictedBatch], model: ModelId
) -> Prepared | None:
    """Move the points of a noisy tile onto their charts and prepare it again.

    Args:
        prepared: the tile.
        batches: its charts, in any order.
        model: weights of the network.

    Returns:
        The prepared tile; ``None`` if its points hardly move.
    """
    from pugeo_model import local_stages

    start = time.perf_counter()
    assert prepared.tile is not None
    moved = local_stages.denoise(load_model(model), prepared.tile, _charts(batches))
    if moved is None:
        return None
    again = prepare_tile(Opaque(moved))
    return Prepared(None, again.tile, {"prepare": time.perf_counter() - start})


@quick
def describe_denoised(denoised: Prepared | None) -> PreparedInfo | None:
    """Describe a tile that was prepared again."""
    return None if denoised is None else describe_prepared(denoised)


def densify(prepared: Prepared, batches: Sequence[PredictedBatch], model: ModelId) -> DenseTile:
    """Make the dense points of a tile from its charts.

    It is one task: the values between its steps are larger than its result, and each task costs
    the front some 3 ms.

    Args:
        prepared: the tile.
        batches: its charts, in any order.
        model: weights of the network.
    """
    from pugeo_model import local_stages
    from pugeo_model.stage_times import StageTimes

    times = StageTimes()
    assert prepared.tile is not None
    tile = local_stages.densify(load_model(model), prepared.tile, _charts(batches), times)
    sizes: Batches = [(batch.seconds, len(batch.charts)) for batch in batches]
    return DenseTile(tile, times.seconds, sizes)


@quick
def describe_dense(dense: DenseTile) -> DenseInfo:
    """Describe a dense tile to the front."""
    return DenseInfo(dense.seconds, dense.batches)


def _charts(batches: Sequence[PredictedBatch]) -> list[Predicted]:
    return [charts for batch in batches for charts in batch.charts]
