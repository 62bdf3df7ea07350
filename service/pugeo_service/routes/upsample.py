# SPDX-License-Identifier: Apache-2.0
"""``POST /upsample``: a cloud in, a denser one out."""

from typing import Annotated, Any

import structlog
from fastapi import APIRouter, Query, Request, Response

from pugeo_model.errors import CloudError
from pugeo_service.admission import Hold
from pugeo_service.answer import DenseAnswer, answer_headers
from pugeo_service.body import Body, ClientGone, receive_body
from pugeo_service.disconnect import DeadlinePassed, while_connected
from pugeo_service.engine import EngineLost, Order, Outcome, WorkerLost
from pugeo_service.negotiation import DEFAULT, OFFERS, Offer, choose
from pugeo_service.options import UpsampleQuery
from pugeo_service.problems import Problem, problem_responses
from pugeo_service.state import Service, ServiceDep

__all__ = ["router"]

router = APIRouter(tags=["upsample"])
_log = structlog.stdlib.get_logger("pugeo.upsample")

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_POINTS = {
    "type": "object",
    "required": ["points"],
    "properties": {
        "points": {
            "type": "array",
            "items": {
                "type": "array",
                "items": {"type": "number"},
                "minItems": 3,
                "maxItems": 3,
            },
        }
    },
}
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A point cloud; where the type is unspecific, the content decides.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}},
                }
            },
            "application/json": {"schema": _POINTS},
            "application/x-ply": _BINARY,
            "application/x-npz": _BINARY,
            "application/x-npy": _BINARY,
            "application/octet-stream": _BINARY,
            "text/plain": {"schema": {"type": "string"}},
        },
    }
}
_HEADERS = {
    name: {"description": text, "schema": {"type": kind}}
    for name, kind, text in (
        ("X-Request-ID", "string", "the request's own id, or a new one"),
        ("Pugeo-Model-Version", "string", "version of the model"),
        ("Pugeo-Model-Sha256", "string", "sha256 of its weights"),
        ("Pugeo-Points-In", "integer", "points read"),
        ("Pugeo-Points-Out", "integer", "points returned"),
        ("Pugeo-Dropped-Non-Finite", "integer", "points dropped for NaN or infinity"),
        ("Pugeo-Dropped-Duplicate", "integer", "points dropped for being there twice"),
        ("Pugeo-Notes", "string", "JSON array of sentences about guesses that were made"),
        ("Server-Timing", "string", "milliseconds by stage"),
    )
}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The dense cloud, in the format asked for.",
        "headers": _HEADERS,
        "content": {offer.media_type: _BINARY for offer in OFFERS.values()},
    },
    **problem_responses(400, 406, 408, 413, 415, 422, 500, 503, 504),
}


@router.post(
    "/upsample",
    operation_id="upsample",
    response_class=Response,
    responses=_RESPONSES,
    openapi_extra=_BODY,
)
async def upsample(
    request: Request, query: Annotated[UpsampleQuery, Query()], service: ServiceDep
) -> Response:
    """Upsample the point cloud in the body: R times as many points, each with a normal."""
    try:
        offer = _offer(request, query)
        outcome = await _serve(request, service, offer, query)
    except (Problem, CloudError) as error:
        service.telemetry.rejected.labels(error.code).inc()
        raise
    _count(service, outcome)
    return DenseAnswer(outcome, answer_headers(outcome, offer, service.card))


def _offer(request: Request, query: UpsampleQuery) -> Offer:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    default = OFFERS["json"] if kind == "application/json" else DEFAULT
    return choose(request.headers.get("accept"), query.format, default)


async def _serve(request: Request, service: Service, offer: Offer, query: UpsampleQuery) -> Outcome:
    if service.not_ready_because == "no_worker":
        raise Problem(503, "no_worker", "No worker is warm yet; try again.", retry_after=2)
    with service.admission.hold() as hold:
        body = await receive_body(request, service.settings, hold)
        with body.spool:
            hold.enter(Order.estimate(body.spool.size))
            return await _run(request, service, body, offer, query, hold)


async def _run(
    request: Request,
    service: Service,
    body: Body,
    offer: Offer,
    query: UpsampleQuery,
    hold: Hold,
) -> Outcome:
    settings = service.settings
    order = Order(
        model=settings.model,
        format=body.format,
        answer=offer.name,
        options=query.for_model(),
        max_points=settings.max_points,
        max_output_points=settings.max_output_points,
        batch_patches=settings.batch_patches,
        deadline_s=settings.deadline_s,
    )
    work = service.engine.run(body.spool, order, on_patches=hold.resize, on_done=hold.finish)
    try:
        return await while_connected(request, work, settings.deadline_s)
    except ClientGone:
        service.telemetry.cancelled.labels("disconnect").inc()
        raise
    except DeadlinePassed as error:
        service.telemetry.cancelled.labels("deadline").inc()
        detail = f"The request took longer than {settings.deadline_s:g} s, its limit."
        fields = {"limit": settings.deadline_s}
        raise Problem(504, "deadline_exceeded", detail, fields=fields) from error
    except WorkerLost as error:
        _log.error("a request ended its workers", reason=str(error))
        detail = (
            "Working on this cloud ended the worker process every time, most likely because it "
            "ran out of memory. A smaller cloud or a lower R may work; the same will not."
        )
        raise Problem(422, "worker_lost", detail, retryable=False) from error
    except EngineLost as error:
        _log.error("the engine is gone", reason=str(error))
        detail = "The workers cannot be reached at the moment."
        raise Problem(503, "engine_lost", detail, retry_after=5) from error
    except MemoryError as error:
        detail = "This cloud needs more memory than a worker has; send a smaller one or lower R."
        raise Problem(422, "out_of_memory", detail, retryable=False) from error


def _count(service: Service, outcome: Outcome) -> None:
    telemetry = service.telemetry
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
