# SPDX-License-Identifier: Apache-2.0
"""What a request and a job have in common: how they order work, and how its failures are told."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import structlog

from pugeo_service.engine import DiskError, EngineLostError, RunRequest, RunResult, WorkerLostError
from pugeo_service.http.negotiation import DEFAULT, OFFERS, Offer, choose
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problem

__all__ = ["count_run", "engine_problems", "make_run_request", "offer_of"]

_log = structlog.stdlib.get_logger("pugeo.work")


def offer_of(headers: Mapping[str, str], wanted: str | None) -> Offer:
    """Choose the format of an answer by the headers of a request and its ``?format=``.

    Raises:
        ProblemError: 406 or 422, as `choose`.
    """
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    default = OFFERS["json"] if kind == "application/json" else DEFAULT
    return choose(headers.get("accept"), wanted, default)


def make_run_request(
    settings: Settings,
    options: dict[str, Any],
    *,
    format: str | None,
    answer: str,
    deadline_s: float,
    background: bool = False,
) -> RunRequest:
    """Make the order for a body; arguments are those of `RunRequest` that no setting decides."""
    return RunRequest(
        model=settings.model,
        format=format,
        answer=answer,
        options=options,
        max_points=settings.max_points,
        max_output_points=settings.max_output_points,
        deadline_s=deadline_s,
        background=background,
    )


@contextmanager
def engine_problems() -> Iterator[None]:
    """Turn what the engine raises within the block into problems.

    Raises:
        ProblemError: 422 ``worker_lost`` or ``out_of_memory``: the cloud is too much for a worker;
            503 ``engine_lost``: the workers cannot be reached; 503 as `storage_problem`.
    """
    try:
        yield
    except WorkerLostError as error:
        _log.error("a cloud ended its workers", reason=str(error))
        detail = (
            "Working on this cloud ended the worker process every time, most likely because it "
            "ran out of memory. A smaller cloud or a lower R may work; the same will not."
        )
        raise ProblemError(422, "worker_lost", detail, retryable=False) from error
    except EngineLostError as error:
        _log.error("the engine is gone", reason=str(error))
        detail = "The workers cannot be reached at the moment."
        raise ProblemError(503, "engine_lost", detail, retry_after=5) from error
    except DiskError as error:
        raise storage_problem(error.error) from error
    except MemoryError as error:
        detail = "This cloud needs more memory than a worker has; send a smaller one or lower R."
        raise ProblemError(422, "out_of_memory", detail, retryable=False) from error


def count_run(telemetry: Telemetry, outcome: RunResult) -> None:
    """Count a run that succeeded: its stages, its batches, its points."""
    for stage, seconds in outcome.seconds.items():
        if stage == "queue":
            telemetry.queue_wait.observe(seconds)
        else:
            telemetry.stage_seconds.labels(stage).observe(seconds)
    for seconds, patches in outcome.batches:
        telemetry.batch_seconds.observe(seconds)
        telemetry.batch_patches.observe(patches)
    telemetry.points.labels("in").inc(outcome.report["points_in"])
    telemetry.points.labels("out").inc(outcome.report["points_out"])
