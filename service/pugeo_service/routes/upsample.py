# SPDX-License-Identifier: Apache-2.0
"""``POST /upsample``: a cloud in, a denser one out."""

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from pugeo_model.errors import CloudError
from pugeo_service.admission.admission import Hold
from pugeo_service.admission.deadline import Deadline
from pugeo_service.container import Service, ServiceDep
from pugeo_service.engine import RunRequest, RunResult
from pugeo_service.http.body import Body, ClientDisconnectedError, receive_body
from pugeo_service.http.cancellation import DeadlinePassedError, while_connected
from pugeo_service.http.negotiation import OFFERS, Offer
from pugeo_service.http.prefer import preferences
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.http.responses import DenseAnswer, answer_headers
from pugeo_service.keys import owner_of
from pugeo_service.observability.tracing import StageSpans
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, HEADERS
from pugeo_service.runs import count_run, engine_problems, make_run_request, offer_of
from pugeo_service.storage.spool import Spool

__all__ = ["router"]

router = APIRouter(tags=["upsample"])

_PREFER = {
    "name": "Prefer",
    "in": "header",
    "required": False,
    "description": "wait=N: give up, with 503 or 504, what would take longer than N seconds.",
    "schema": {"type": "string", "examples": ["wait=30"]},
}
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The dense cloud, in the format asked for.",
        "headers": HEADERS,
        "content": {offer.media_type: BINARY for offer in OFFERS.values()},
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
    deadline = Deadline(preferences(request.headers), service.settings.deadline_s)
    try:
        offer = offer_of(request.headers, query.format)
        outcome = await _serve(request, service, offer, query, deadline)
    except (ProblemError, CloudError) as error:
        service.telemetry.rejected.labels(error.code).inc()
        raise
    count_run(service.telemetry, outcome)
    for seconds, patches in outcome.batches:
        service.admission.pace.add(seconds, patches)
    headers = answer_headers(outcome, offer, service.card)
    if deadline.wait is not None:
        headers["Preference-Applied"] = f"wait={deadline.wait}"
    return DenseAnswer(outcome, headers)


async def _serve(
    request: Request, service: Service, offer: Offer, query: UpsampleQuery, deadline: Deadline
) -> RunResult:
    if service.not_ready_because == "no_worker":
        raise ProblemError(503, "no_worker", "No worker is warm yet; try again.", retry_after=2)
    with service.admission.hold(owner_of(request)) as hold:
        try:
            async with deadline.arriving():
                body = await receive_body(request, service.settings, hold)
            with body.spool:
                hold.enter(RunRequest.estimate(body.spool.size, body.format))
                hold.check_deadline(deadline.left, service.engine.status.workers, sized=False)
                return await _run(request, service, body, offer, query, hold, deadline)
        except DeadlinePassedError as error:
            service.telemetry.cancelled.labels("deadline").inc()
            detail = f"The request took longer than {deadline.shown}."
            fields = {"limit": deadline.seconds}
            raise ProblemError(504, "deadline_exceeded", detail, fields=fields) from error


async def _run(
    request: Request,
    service: Service,
    body: Body[Spool],
    offer: Offer,
    query: UpsampleQuery,
    hold: Hold,
    deadline: Deadline,
) -> RunResult:
    settings = service.settings
    # The deadline is the service's own and never the client's: a worker that overruns it is ended.
    order = make_run_request(
        settings,
        query.for_model(),
        format=body.format,
        answer=offer.name,
        deadline_s=settings.deadline_s,
    )
    hopeless = asyncio.get_running_loop().create_future()

    def on_patches(count: int) -> None:
        hold.resize(count)
        try:
            hold.check_deadline(deadline.left, service.engine.status.workers, sized=True)
        except ProblemError as problem:
            if not hopeless.done():
                hopeless.set_exception(problem)

    spans = StageSpans()
    work = service.engine.run(
        body.spool,
        order,
        on_patches=on_patches,
        on_done=hold.finish,
        on_stage=spans.on_stage,
    )
    seconds = None
    try:
        with engine_problems():
            outcome = await while_connected(request, work, deadline.left, hopeless)
    except ClientDisconnectedError:
        service.telemetry.cancelled.labels("disconnect").inc()
        raise
    else:
        seconds = outcome.seconds
        return outcome
    finally:
        spans.finish(seconds)
