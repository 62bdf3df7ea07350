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
from pugeo_service.engine.values import Carried, Charted, Cut, Finished, Prepared, Written
from pugeo_service.shared_file import SharedFile

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
    "describe_prepared",
    "describe_written",
    "finish",
    "finish_tile",
    "load_model",
    "predict",
    "predict_part",
    "prepare",
    "prepare_tile",
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
    plan = pipeline.survey(cloud, options, patch_ratio=load_model(order.model).patch_ratio)
    job = pipeline.prepare(plan.tile(0)) if len(plan.cuts) == 1 else None
    seconds = {"read": read - start, "prepare": time.perf_counter() - read}
    by_rows = plan.tiles_in_order and formats.by_rows(plan.cloud, order.answer)
    prepared = Prepared(plan, job, seconds, by_rows)
    if job is not None and len(job.patches) <= order.at_once_patches:
        return _at_once(prepared, order)
    return prepared


def _at_once(prepared: Prepared, order: Order) -> Prepared:
    """Go all the way: passing it on would take longer than the work, or gain nothing."""
    seconds, predicting = dict(prepared.seconds), 0.0

    def predicted() -> list[Charted]:
        nonlocal predicting
        charted = predict_part(prepared, 0, len(prepared.job.patches), order.model)
        predicting += charted.seconds
        return [charted]

    charted = predicted()
    if pipeline.noisy(prepared.job):
        again = denoise(prepared, charted, order.model)
        seconds["prepare"] += again.seconds["prepare"]
        if again.job is not prepared.job:
            prepared = again
            charted = predicted()
    written = finish(prepared, charted, order.model, order.answer)
    seconds["predict"] = predicting
    return replace(prepared, seconds=seconds, written=written)


def describe_prepared(prepared: Prepared, file: SharedFile | None = None) -> Head:
    """Return what the front needs to know of a prepared cloud or tile.

    Args:
        prepared: the cloud or tile.
        file: of the front, where the answer goes if it is there already; ``None`` of a tile.
    """
    plan, job = prepared.plan, prepared.job
    patches = plan.report["patches"] if job is None else len(job.patches)
    tiles = 1 if job is not None else len(plan.cuts)
    sheet = None if prepared.written is None else describe_written(prepared.written, file)
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


def denoise(prepared: Prepared, batches: Sequence[Charted], model: str) -> Prepared:
    """Prepare a noisy cloud, or tile, anew from where its points land.

    Args:
        prepared: the cloud or tile.
        batches: its charts, in the order of the patches.
        model: name of the weights.
    """
    start = time.perf_counter()
    spots = pipeline.own_spots(prepared.job, _charts(batches))
    job = pipeline.denoise(prepared.job, pipeline.land(load_model(model), spots))
    gone = _sizes(batches) if job is not prepared.job else []
    return replace(
        prepared, job=job, seconds={"prepare": time.perf_counter() - start}, batches=gone
    )


def finish_tile(prepared: Prepared, batches: Sequence[Charted], model: str) -> Finished:
    """From charts to dense points: where they go and land, and the rest that decides on a tile.

    It is one task: what is between its steps is larger than its result, and each task costs the
    front some milliseconds.

    Args:
        prepared: the cloud or tile.
        batches: its charts, in the order of the patches.
        model: name of the weights.
    """
    job, charts, clock = prepared.job, _charts(batches), _Clock()
    if job.tile.patch_ratio is not None:
        points = clock("merge", pipeline.merge_patches, job, charts)
        piece = clock("finish", pipeline.finish, job, points)
        return Finished(piece, clock.seconds, _sizes(batches))
    network = load_model(model)
    spots = clock("merge", pipeline.propose, job, charts)
    candidates = clock("land", pipeline.land, network, spots)
    spots = clock("merge", pipeline.merge, job, charts, candidates)
    del candidates  # which are many
    points = clock("land", pipeline.land, network, spots)
    del spots, charts
    piece = clock("finish", pipeline.finish, job, points)
    return Finished(piece, clock.seconds, _sizes(batches))


def finish(prepared: Prepared, batches: Sequence[Charted], model: str, answer: str) -> Written:
    """From charts to the bytes of the answer in the format ``answer``; see `finish_tile`."""
    part = finish_tile(prepared, batches, model)
    written = assemble(prepared, [part], answer)
    seconds = {**part.seconds, **written.seconds}
    seconds["finish"] += part.seconds["finish"]
    return replace(written, seconds=seconds, batches=part.batches)


class _Clock:
    """Adds up what calls take, by name."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(("land", "merge", "finish"), 0.0)

    def __call__(self, name: str, call: Callable[..., Any], *args: Any) -> Any:
        start = time.perf_counter()
        result = call(*args)
        self.seconds[name] += time.perf_counter() - start
        return result


def _charts(batches: Sequence[Charted]) -> list[Any]:
    return [chart for batch in batches for chart in batch.charts]


def _sizes(batches: Sequence[Charted]) -> list[tuple[float, int]]:
    return [(batch.seconds, len(batch.charts)) for batch in batches]


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
