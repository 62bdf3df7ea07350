# SPDX-License-Identifier: Apache-2.0
"""``POST /upsample``: upsampling within one request."""

import asyncio
from contextlib import ExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from pugeo_model.errors import CloudError
from pugeo_service.admission.admission import Reservation
from pugeo_service.admission.deadline import Deadline, DeadlinePassedError
from pugeo_service.container import Service, ServiceDep
from pugeo_service.engine import RunRequest, RunResult
from pugeo_service.http.body import Body, ClientDisconnectedError, receive_body
from pugeo_service.http.cancellation import while_connected
from pugeo_service.http.negotiation import (
    OUTPUT_FORMATS,
    OutputChoice,
    OutputFormat,
    choose_format,
)
from pugeo_service.http.prefer import preferred_wait
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.http.responses import SpoolResponse, response_headers
from pugeo_service.keys import owner_of
from pugeo_service.observability.tracing import StageSpans
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, HEADERS
from pugeo_service.runs import count_run, engine_problems, make_run_request
from pugeo_service.storage.spool import Spool

__all__ = ["router"]

router = APIRouter(tags=["upsample"])

_PREFER = {
    "name": "Prefer",
    "in": "header",
    "required": False,
    "description": "wait=N: answer with 503 or 504 if the request takes longer than N seconds.",
    "schema": {"type": "string", "examples": ["wait=30"]},
}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The dense cloud in the requested format.",
        "headers": HEADERS,
        "content": {output.media_type: BINARY for output in OUTPUT_FORMATS.values()},
    },
    **problem_responses(400, 401, 406, 408, 413, 415, 422, 429, 500, 503, 504),
}


@router.post(
    "/upsample",
    operation_id="upsample",
    response_class=Response,
    responses=_RESPONSES,
    openapi_extra={**BODY, "parameters": [_PREFER]},
)
async def upsample(
    request: Request, query: Annotated[UpsampleQuery, Query()], service: ServiceDep
) -> Response:
    """Upsample the point cloud in the body: R times as many points, each with a normal."""
    deadline = Deadline(preferred_wait(request.headers), service.settings.deadline_s)
    with ExitStack() as held:
        try:
            choice = choose_format(request.headers.get("accept"), query.format)
            result, output = await _serve(request, service, choice, query, deadline, held)
        except (ProblemError, CloudError) as error:
            service.telemetry.rejected.labels(error.code).inc()
            raise
        count_run(service.telemetry, result)
        for seconds, patches in result.batches:
            service.admission.patch_cost.add(seconds, patches)
        headers = response_headers(result, output, service.card)
        if deadline.wait is not None:
            headers["Preference-Applied"] = f"wait={deadline.wait}"
        return SpoolResponse(result, headers, held.pop_all())


async def _serve(
    request: Request,
    service: Service,
    choice: OutputChoice,
    query: UpsampleQuery,
    deadline: Deadline,
    held: ExitStack,
) -> tuple[RunResult, OutputFormat]:
    """Run a request; the reservation in ``held`` then holds the bytes of the answer."""
    if service.not_ready_because == "no_worker":
        raise ProblemError(
            503,
            "no_worker",
            "No worker is ready yet; try again after the time in Retry-After.",
            retry_after=2,
        )
    reservation = held.enter_context(service.admission.reserve(owner_of(request)))
    try:
        async with deadline.receiving_body():
            body = await receive_body(request, service.settings, reservation)
        with body.spool:
            output = choice.for_input(body.read_as)
            reservation.admit(RunRequest.estimate(body.spool.size, body.format))
            workers = service.engine.status.workers
            reservation.check_deadline(deadline.remaining, workers, counted=False)
            result = await _run(request, service, body, output, query, reservation, deadline)
    except DeadlinePassedError as error:
        service.telemetry.cancelled.labels("deadline").inc()
        detail = f"The request took longer than {deadline.description}."
        fields = {"limit": deadline.seconds, "setting": "PUGEO_DEADLINE_S"}
        raise ProblemError(504, "deadline_exceeded", detail, fields=fields) from error
    reservation.hold_answer(result.spool.size)
    return result, output


async def _run(
    request: Request,
    service: Service,
    body: Body[Spool],
    output: OutputFormat,
    query: UpsampleQuery,
    reservation: Reservation,
    deadline: Deadline,
) -> RunResult:
    settings = service.settings
    # The limit of the service, not the client's time: a worker that exceeds it is ended.
    run_request = make_run_request(
        settings,
        query.for_model(),
        format=body.format,
        answer=output.name,
        deadline_s=settings.deadline_s,
    )
    abort = asyncio.get_running_loop().create_future()

    def on_patches(count: int) -> None:
        reservation.set_patches(count)
        try:
            workers = service.engine.status.workers
            reservation.check_deadline(deadline.remaining, workers, counted=True)
        except ProblemError as problem:
            if not abort.done():
                abort.set_exception(problem)

    spans = StageSpans()
    work = service.engine.run(
        body.spool,
        run_request,
        on_patches=on_patches,
        on_done=reservation.finish,
        on_stage=spans.on_stage,
    )
    seconds = None
    try:
        with engine_problems():
            result = await while_connected(request, work, deadline.remaining, abort)
    except ClientDisconnectedError:
        service.telemetry.cancelled.labels("disconnect").inc()
        raise
    else:
        seconds = result.seconds
        return result
    finally:
        spans.finish(seconds)
