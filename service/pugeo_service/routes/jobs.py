# SPDX-License-Identifier: Apache-2.0
"""``/jobs``: upsampling in the background."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse
from starlette.types import Receive, Scope, Send

from pugeo_model.errors import CloudError
from pugeo_service.container import ServiceDep
from pugeo_service.http.negotiation import OUTPUT_FORMATS, choose_format
from pugeo_service.http.query import JobQuery
from pugeo_service.jobs.api_models import JobPage, JobResponse
from pugeo_service.jobs.events import stream
from pugeo_service.jobs.models import Job, State
from pugeo_service.jobs.result import check_available, result_response
from pugeo_service.jobs.submission import idempotency_key
from pugeo_service.keys import owner_of
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, CANARY, HEADERS

__all__ = ["router"]

router = APIRouter(prefix="/jobs", tags=["jobs"])


class _EventStream(EventSourceResponse):
    """Response whose subscription begins before its headers are sent and ends with it.

    A subscription that is refused is thus still a problem, and one whose client left before the
    first event is not forgotten.

    Args:
        subscription: entered for the time of the response.
        body: returns the events for the queue of the subscription.
    """

    def __init__(
        self,
        subscription: AbstractContextManager["asyncio.Queue[Job | None]"],
        body: Callable[["asyncio.Queue[Job | None]"], AsyncIterator[bytes]],
    ) -> None:
        super().__init__((), headers={"Cache-Control": "no-store"})
        self._subscription = subscription
        self._body = body

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send headers and events."""
        with self._subscription as changes:
            self.body_iterator = self._body(changes)
            await super().__call__(scope, receive, send)


JobId = Annotated[str, Path(max_length=64, description="id of a job")]
_POLL_S = "1"
_LOCATION = {"Location": {"description": "the job", "schema": {"type": "string"}}}
_RESULT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The dense cloud in the requested format.",
        "headers": {
            **HEADERS,
            "ETag": {"description": "sha256 of the bytes", "schema": {"type": "string"}},
        },
        "content": {output.media_type: BINARY for output in OUTPUT_FORMATS.values()},
    },
    206: {"description": "The part that Range requests."},
    304: {"description": "Not modified: If-None-Match contains the ETag."},
    # A failed job is reported with the status that /upsample would have.
    **problem_responses(400, 404, 409, 410, 413, 415, 416, 422, 500, 503, 504),
}


@router.post(
    "",
    operation_id="submit_job",
    status_code=202,
    responses={
        202: {"description": "Accepted; the job survives a restart of the service.",
              "headers": _LOCATION},
        200: {"description": "A job with this Idempotency-Key is already finished.",
              "model": JobResponse, "headers": _LOCATION},
        **problem_responses(400, 401, 406, 408, 413, 415, 422, 429, 500, 503),
    },
    openapi_extra={**BODY, "parameters": [CANARY]},
)  # fmt: skip
async def submit(
    request: Request,
    response: Response,
    query: Annotated[JobQuery, Query()],
    service: ServiceDep,
    _idempotency_key: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            description="Name of this request, given by the client; a repeated request returns "
            "the same job.",
        ),
    ] = None,
) -> JobResponse:
    """Accept a point cloud to upsample; the body and the options are those of /upsample."""
    try:
        choice = choose_format(request.headers.get("accept"), query.format)
        owner, key = owner_of(request), idempotency_key(request)
        job, _ = await service.jobs.submit(request, query, choice, owner, key)
    except (ProblemError, CloudError) as error:
        service.telemetry.rejected.labels(error.code).inc()
        raise
    response.status_code = 200 if job.finished else 202
    response.headers["Location"] = f"/jobs/{job.id}"
    if not job.finished:
        response.headers["Retry-After"] = _POLL_S
    return JobResponse.from_job(job)


@router.get("", operation_id="list_jobs", responses=problem_responses(401, 404, 422, 503))
async def list_jobs(
    request: Request,
    service: ServiceDep,
    state: Annotated[State | None, Query(description="only jobs in this state")] = None,
    limit: Annotated[int, Query(ge=1, le=100, description="number of jobs per page")] = 20,
    cursor: Annotated[
        str | None, Query(max_length=64, description="`next` of the previous page")
    ] = None,
) -> JobPage:
    """List jobs, newest first."""
    jobs, following = await service.jobs.page(owner_of(request), state, cursor, limit)
    return JobPage(jobs=[JobResponse.from_job(job) for job in jobs], next=following)


@router.get("/{job_id}", operation_id="get_job", responses=problem_responses(401, 404, 422, 503))
async def get_job(
    job_id: JobId, request: Request, response: Response, service: ServiceDep
) -> JobResponse:
    """Return state, progress and result of a job."""
    job = await service.jobs.get(job_id, owner_of(request))
    if not job.finished:
        response.headers["Retry-After"] = _POLL_S
    return JobResponse.from_job(job)


@router.get(
    "/{job_id}/events",
    operation_id="job_events",
    response_class=Response,
    responses={
        200: {
            "description": "Events `state`, `progress` and, at the end, `end`.",
            "content": {"text/event-stream": {}},
        },
        **problem_responses(401, 404, 422, 429, 503),
    },
)
async def events(
    job_id: JobId,
    request: Request,
    service: ServiceDep,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID")] = None,
) -> Response:
    """Send each change of a job until its end, as server-sent events."""
    owner = owner_of(request)
    job = await service.jobs.get(job_id, owner)

    def is_valid() -> bool:
        return not service.keys.required or service.keys.owner(request.headers) == owner

    subscription = service.jobs.changes.subscribe(job_id, job.revision, owner, is_valid)
    return _EventStream(subscription, lambda changes: stream(job, changes, last_event_id))


@router.get(
    "/{job_id}/result", operation_id="job_result", response_class=Response, responses=_RESULT
)
async def result(job_id: JobId, request: Request, service: ServiceDep) -> Response:
    """Return the dense cloud of a job; supports ETag, Range and If-Range."""
    job = await service.jobs.get(job_id, owner_of(request))
    check_available(job)
    return await asyncio.to_thread(result_response, request, job, service.jobs.files)


@router.delete(
    "/{job_id}", operation_id="delete_job", responses=problem_responses(401, 404, 422, 503)
)
async def delete_job(job_id: JobId, request: Request, service: ServiceDep) -> JobResponse:
    """Cancel an active job, or delete the result of a finished one. Idempotent."""
    return JobResponse.from_job(await service.jobs.withdraw(job_id, owner_of(request)))
