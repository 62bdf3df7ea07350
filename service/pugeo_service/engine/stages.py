# SPDX-License-Identifier: Apache-2.0
"""The steps of a request as functions that run in a worker process.

Values between them stay on the workers; only what describes them, and chunks of answers, travel
to the front.
"""

import functools
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pugeo_model import formats, pipeline, weights
from pugeo_model.cloud import Cloud
from pugeo_model.errors import LimitExceeded
from pugeo_model.formats.limits import Limits
from pugeo_model.options import Options
from pugeo_service.engine.answers import (
    agree,
    assemble,
    at_once,
    border,
    chunk,
    describe_agreed,
    describe_finished,
    describe_written,
    write_tile,
)
from pugeo_service.engine.order import Head, Order
from pugeo_service.engine.values import Carried, Charted, Cut, Finished, Merged, Prepared, Written

__all__ = [
    "agree",
    "assemble",
    "at_once",
    "border",
    "chunk",
    "cut_patches",
    "cut_tile",
    "denoise",
    "describe_agreed",
    "describe_finished",
    "describe_merged",
    "describe_prepared",
    "describe_written",
    "finish",
    "finish_tile",
    "land_part",
    "load_model",
    "merge",
    "own_spots",
    "predict",
    "predict_part",
    "prepare",
    "prepare_tile",
    "propose",
    "write_tile",
]


@functools.lru_cache(maxsize=2)
def load_model(name: str) -> Any:
    """Return the model called ``name``, loaded once for each process."""
    return weights.load(name)


def prepare(body: NDArray[np.uint8], order: Order) -> Prepared:
    """Read the bytes of a body, uint8 ``(size,)``, and cut the cloud into patches.

    Raises:
        CloudError: everything that can be wrong with an input.
    """
    start = time.perf_counter()
    options = Options(**order.options)
    limits = Limits(max_points=order.max_points)
    cloud = formats.read(io.BytesIO(body.data), format=order.format, limits=limits)
    _check_output(cloud, options, order.max_output_points)
    read = time.perf_counter()
    plan = pipeline.survey(cloud, options)
    job = pipeline.prepare(plan.tile(0)) if len(plan.cuts) == 1 else None
    seconds = {"read": read - start, "prepare": time.perf_counter() - read}
    by_rows = plan.tiles_in_order and formats.by_rows(plan.cloud, order.answer)
    prepared = Prepared(plan, job, seconds, by_rows)
    if job is not None and len(job.patches) <= order.at_once_patches:
        return _at_once(prepared, order)
    return prepared


def _at_once(prepared: Prepared, order: Order) -> Prepared:
    """Go all the way: passing it on would take longer than the work, or gain nothing."""
    charted = predict_part(prepared, 0, len(prepared.job.patches), order.model)
    denoising, batches = 0.0, []
    if pipeline.noisy(prepared.job):
        start = time.perf_counter()
        spots = own_spots(prepared, [charted])
        again = denoise(prepared, [land(spots.landings, order.model)])
        denoising = time.perf_counter() - start
        if again.job is not prepared.job:
            denoising += charted.seconds
            batches += spots.batches
            prepared = replace(prepared, job=again.job)
            charted = predict_part(prepared, 0, len(prepared.job.patches), order.model)
    proposed = propose(prepared, [charted])
    start = time.perf_counter()
    candidates = land(proposed.landings, order.model)
    landing = time.perf_counter() - start
    merged = merge(prepared, [charted], [candidates])
    start = time.perf_counter()
    landed = land(merged.landings, order.model)
    landing += time.perf_counter() - start
    written = finish(prepared, [landed], order.answer)
    seconds = {
        **prepared.seconds,
        "prepare": prepared.seconds["prepare"] + denoising,
        "predict": charted.seconds,
        "land": landing,
        "merge": proposed.seconds + merged.seconds,
    }
    return replace(
        prepared, seconds=seconds, written=written, batches=(*batches, *proposed.batches)
    )


def describe_prepared(prepared: Prepared) -> Head:
    """Return what the front needs to know of a prepared cloud or tile."""
    plan, job = prepared.plan, prepared.job
    patches = plan.report["patches"] if job is None else len(job.patches)
    tiles = 1 if job is not None else len(plan.cuts)
    sheet = None if prepared.written is None else describe_written(prepared.written)
    noisy = job is not None and sheet is None and pipeline.noisy(job)
    return Head(patches, tiles, prepared.seconds, prepared.by_rows, sheet, prepared.batches, noisy)


def cut_tile(prepared: Prepared, number: int) -> Carried:
    """Return a tile, so that only it travels to the worker that prepares it."""
    return Carried(prepared.plan.tile(number))


def prepare_tile(tile: Carried) -> Prepared:
    """Cut a tile into patches."""
    start = time.perf_counter()
    job = pipeline.prepare(tile.value)
    return Prepared(None, job, {"prepare": time.perf_counter() - start})


def cut_patches(prepared: Prepared, start: int, stop: int) -> Cut:
    """Return some patches, so that only they travel to the worker that runs them."""
    return Cut(prepared.job.patches[start:stop], prepared.job.candidates)


def predict(part: Cut, model: str) -> Charted:
    """Run patches through the network."""
    start = time.perf_counter()
    network = load_model(model)
    charts = [pipeline.predict(network, patch, part.candidates) for patch in part.patches]
    return Charted(charts, time.perf_counter() - start)


def predict_part(prepared: Prepared, start: int, stop: int, model: str) -> Charted:
    """Run patches through the network where they are."""
    return predict(cut_patches(prepared, start, stop), model)


def own_spots(prepared: Prepared, batches: Sequence[Charted]) -> Merged:
    """Gather the input's points; ``batches`` are in the order of the patches."""
    return _spots(pipeline.own_spots, prepared, batches)


def denoise(prepared: Prepared, batches: Sequence[list[Any]]) -> Prepared:
    """Prepare a noisy cloud, or tile, anew from where its points landed."""
    start = time.perf_counter()
    job = pipeline.denoise(prepared.job, [landed for batch in batches for landed in batch])
    return replace(prepared, job=job, seconds={"prepare": time.perf_counter() - start})


def propose(prepared: Prepared, batches: Sequence[Charted]) -> Merged:
    """Gather the candidates of all charts; ``batches`` are in the order of the patches."""
    return _spots(pipeline.propose, prepared, batches)


def _spots(
    choose: Callable[..., list[Any]], prepared: Prepared, batches: Sequence[Charted]
) -> Merged:
    start = time.perf_counter()
    landings = choose(prepared.job, [chart for b in batches for chart in b.charts])
    sizes = [(batch.seconds, len(batch.charts)) for batch in batches]
    return Merged(landings, time.perf_counter() - start, sizes)


def merge(
    prepared: Prepared, batches: Sequence[Charted], candidates: Sequence[list[Any]]
) -> Merged:
    """Decide where the points of the answer go."""
    start = time.perf_counter()
    landings = pipeline.merge(
        prepared.job,
        [chart for b in batches for chart in b.charts],
        [landed for batch in candidates for landed in batch],
    )
    return Merged(landings, time.perf_counter() - start, [])


def describe_merged(merged: Merged) -> tuple[int, float, list[tuple[float, int]]]:
    """Return the number of landings, the seconds of merging, and each batch's own."""
    return len(merged.landings), merged.seconds, merged.batches


def land(landings: Sequence[Any], model: str) -> list[Any]:
    """Put points on the surface through the network's heads."""
    network = load_model(model)
    return [pipeline.land(network, landing) for landing in landings]


def land_part(merged: Merged, start: int, stop: int, model: str) -> list[Any]:
    """Put points on the surface where their landings are."""
    return land(merged.landings[start:stop], model)


def finish(prepared: Prepared, batches: Sequence[list[Any]], answer: str) -> Written:
    """Finish the dense cloud and write it in the format ``answer``."""
    part = finish_tile(prepared, batches)
    written = assemble(prepared, [part], answer)
    finishing = written.seconds["finish"] + part.seconds
    return replace(written, seconds={**written.seconds, "finish": finishing})


def finish_tile(prepared: Prepared, batches: Sequence[list[Any]]) -> Finished:
    """Finish the dense points of a tile."""
    start = time.perf_counter()
    piece = pipeline.finish(prepared.job, [landed for batch in batches for landed in batch])
    return Finished(piece, time.perf_counter() - start)


def _check_output(cloud: Cloud, options: Options, limit: int) -> None:
    # Before the work and not after it: preparing five million points takes a while.
    wanted = options.points_out(len(cloud))
    if wanted > limit:
        raise LimitExceeded(
            f"The answer would have {wanted:,} points; the limit is {limit:,}. Lower R.",
            code="too_many_output_points",
            name="max_output_points",
            limit=limit,
            value=wanted,
        )
