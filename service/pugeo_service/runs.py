# SPDX-License-Identifier: Apache-2.0
"""Steps that requests and jobs share: making run requests, reporting failures, counting runs."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import structlog

from pugeo_service.engine import (
    DiskError,
    EngineLostError,
    ModelId,
    RunRequest,
    RunResult,
    WorkerLostError,
    WrongWeightsError,
)
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings
from pugeo_service.storage.problems import storage_problem

__all__ = ["count_run", "engine_problems", "make_run_request"]

_log = structlog.stdlib.get_logger("pugeo.runs")


def make_run_request(
    settings: Settings,
    options: dict[str, Any],
    *,
    model: ModelId,
    format: str | None,
    answer: str,
    deadline_s: float,
    background: bool = False,
    surface_points: int | None = None,
) -> RunRequest:
    """Make a run request; the other attributes of `RunRequest` come from the settings."""
    return RunRequest(
        model=model,
        format=format,
        answer=answer,
        options=options,
        max_points=settings.max_points,
        max_output_points=settings.max_output_points,
        max_cloud_bytes=settings.max_cloud_bytes,
        max_output_bytes=settings.max_output_bytes,
        deadline_s=deadline_s,
        background=background,
        surface_points=surface_points,
    )


@contextmanager
def engine_problems() -> Iterator[None]:
    """Raise errors of the engine within the block as problems.

    Raises:
        ProblemError: 422 ``worker_lost`` or ``out_of_memory``, the cloud needs more memory or time
            than a worker has; 503 ``engine_lost``, the workers cannot be reached; 503
            ``wrong_weights``, they have other weights than the front; 503 of `storage_problem`.
    """
    try:
        yield
    except WorkerLostError as error:
        _log.error("cloud ended its worker processes", reason=str(error))
        detail = (
            "Every worker process that ran this cloud ended, most likely because it ran out of "
            "memory. Send a smaller cloud, lower R, or give workers more "
            "(PUGEO_WORKER_MEMORY); the same request will fail again."
        )
        fields = {"setting": "PUGEO_WORKER_MEMORY"}
        raise ProblemError(422, "worker_lost", detail, retryable=False, fields=fields) from error
    except EngineLostError as error:
        _log.error("engine lost", reason=str(error))
        detail = "The workers cannot be reached; try again after the time in Retry-After."
        raise ProblemError(503, "engine_lost", detail, retry_after=5) from error
    except WrongWeightsError as error:
        _log.error("a worker has other weights", reason=str(error))
        detail = f"The service is not set up in order: {error}."
        raise ProblemError(503, "wrong_weights", detail, retry_after=30) from error
    except DiskError as error:
        raise storage_problem(error.error) from error
    except MemoryError as error:
        detail = (
            "This cloud needs more memory than a worker has; send a smaller one, lower R, or give "
            "workers more (PUGEO_WORKER_MEMORY)."
        )
        fields = {"setting": "PUGEO_WORKER_MEMORY"}
        raise ProblemError(422, "out_of_memory", detail, retryable=False, fields=fields) from error


def count_run(telemetry: Telemetry, result: RunResult, model: Mapping[str, str]) -> None:
    """Count stages, batches and points of a successful run of a model."""
    telemetry.runs.labels(model["name"], model["version"], model["sha256"][:12]).inc()
    for stage, seconds in result.seconds.items():
        if stage == "queue":
            telemetry.queue_wait.observe(seconds)
        else:
            telemetry.stage_seconds.labels(stage).observe(seconds)
    for seconds, patches in result.batches:
        telemetry.batch_seconds.observe(seconds)
        telemetry.batch_patches.observe(patches)
    telemetry.points.labels("in").inc(result.report["points_in"])
    telemetry.points.labels("out").inc(result.report["points_out"])
