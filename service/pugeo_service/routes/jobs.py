# SPDX-License-Identifier: Apache-2.0
"""``/jobs``: clouds to make denser without waiting on the line."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse

from pugeo_model.errors import CloudError
from pugeo_service.container import ServiceDep
from pugeo_service.http.negotiation import OFFERS
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.jobs.api_models import JobsView, JobView
from pugeo_service.jobs.events import stream
from pugeo_service.jobs.models import State
from pugeo_service.jobs.result import check_there, result_answer
from pugeo_service.jobs.submission import key_of
from pugeo_service.keys import owner_of
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, HEADERS
from pugeo_service.runs import offer_of

__all__ = ["router"]

router = APIRouter(prefix="/jobs", tags=["jobs"])

JobId = Annotated[str, Path(max_length=64, description="id of a job")]
_POLL_S = "1"
_LOCATION = {"Location": {"description": "the job", "schema": {"type": "string"}}}
_RESULT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The dense cloud, in the format asked for.",
        "headers": {
            **HEADERS,
            "ETag": {"description": "sha256 of the bytes", "schema": {"type": "string"}},
        },
        "content": {offer.media_type: BINARY for offer in OFFERS.values()},
    },
    206: {"description": "The part of it that Range asks for."},
    304: {"description": "The client has it: If-None-Match names its ETag."},
    # Those of a job that failed are what /upsample would have answered.
    **problem_responses(400, 404, 409, 410, 413, 415, 416, 422, 500, 503, 504),
}


@router.post(
    "",
    operation_id="submit_job",
    status_code=202,
    responses={
        202: {"description": "Accepted: it will be done, also after a restart.",
              "headers": _LOCATION},
        200: {"description": "Sent before under this Idempotency-Key, and finished.",
              "model": JobView, "headers": _LOCATION},
        **problem_responses(400, 401, 406, 408, 413, 415, 422, 429, 500, 503),
    },
    openapi_extra=BODY,
)  # fmt: skip
async def submit(
    request: Request,
    response: Response,
    query: Annotated[UpsampleQuery, Query()],
    service: ServiceDep,
    _idempotency_key: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            description="The client's own name of this request: sent again, it is the same job.",
        ),
    ] = None,
) -> JobView:
    """Accept a point cloud to upsample; the body and the options are those of /upsample."""
    try:
        offer = offer_of(request.headers, query.format)
        owner, key = owner_of(request), key_of(request)
        job, _ = await service.jobs.submit(request, query, offer.name, owner, key)
    except (ProblemError, CloudError) as error:
        service.telemetry.rejected.labels(error.code).inc()
        raise
    response.status_code = 200 if job.finished else 202
    response.headers["Location"] = f"/jobs/{job.id}"
    if not job.finished:
        response.headers["Retry-After"] = _POLL_S
    return JobView.of(job)


@router.get("", operation_id="list_jobs", responses=problem_responses(401, 422, 503))
async def list_jobs(
    request: Request,
    service: ServiceDep,
    state: Annotated[State | None, Query(description="only those in this state")] = None,
    limit: Annotated[int, Query(ge=1, le=100, description="jobs on a page")] = 20,
    cursor: Annotated[
        str | None, Query(max_length=64, description="`next` of the page before")
    ] = None,
) -> JobsView:
    """List jobs, newest first."""
    jobs, following = await service.jobs.page(owner_of(request), state, cursor, limit)
    return JobsView(jobs=[JobView.of(job) for job in jobs], next=following)


@router.get("/{job_id}", operation_id="get_job", responses=problem_responses(401, 404, 503))
async def get_job(
    job_id: JobId, request: Request, response: Response, service: ServiceDep
) -> JobView:
    """Tell the state of a job, how far it is, and what came of it."""
    job = await service.jobs.get(job_id, owner_of(request))
    if not job.finished:
        response.headers["Retry-After"] = _POLL_S
    return JobView.of(job)


@router.get(
    "/{job_id}/events",
    operation_id="job_events",
    response_class=Response,
    responses={
        200: {
            "description": "Events `state`, `progress` and, last of all, `end`.",
            "content": {"text/event-stream": {}},
        },
        **problem_responses(401, 404, 503),
    },
)
async def events(
    job_id: JobId,
    request: Request,
    service: ServiceDep,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID")] = None,
) -> Response:
    """Tell every change of a job until its end, as server-sent events."""
    job = await service.jobs.get(job_id, owner_of(request))
    service.jobs.watch.check()

    async def told() -> AsyncIterator[bytes]:
        with service.jobs.watch.following(job_id) as changes:
            async for event in stream(job, changes, last_event_id):
                yield event

    return EventSourceResponse(told(), headers={"Cache-Control": "no-store"})


async def result(job_id: JobId, request: Request, service: ServiceDep) -> Response:
    """Return the dense cloud that a job made; ETag, Range and If-Range are honoured."""
    job = await service.jobs.get(job_id, owner_of(request))
    check_there(job)
    return await asyncio.to_thread(result_answer, request, job, service.jobs.files.result(job_id))


# HEAD for those who want to know the size first, such as download managers.
router.get(
    "/{job_id}/result", operation_id="job_result", response_class=Response, responses=_RESULT
)(result)
router.head("/{job_id}/result", include_in_schema=False)(result)


@router.delete("/{job_id}", operation_id="delete_job", responses=problem_responses(401, 404, 503))
async def delete_job(job_id: JobId, request: Request, service: ServiceDep) -> JobView:
    """Cancel a job that is not finished, or delete the result of one that is; twice is once."""
    return JobView.of(await service.jobs.withdraw(job_id, owner_of(request)))
