# SPDX-License-Identifier: Apache-2.0
"""``POST /upsample``: upsampling within one request."""

import random
from contextlib import ExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from pugeo_model.errors import CloudError
from pugeo_service.admission.deadline import Deadline
from pugeo_service.container import ServiceDep
from pugeo_service.http.negotiation import OUTPUT_FORMATS, choose_format
from pugeo_service.http.prefer import preferred_wait
from pugeo_service.http.query import UpsampleQuery
from pugeo_service.http.responses import SpoolResponse, response_headers
from pugeo_service.models import wants_canary
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, CANARY, HEADERS
from pugeo_service.routes.serving import serve
from pugeo_service.runs import count_run

__all__ = ["PREFER", "router"]

router = APIRouter(tags=["upsample"])

PREFER = {
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
    openapi_extra={**BODY, "parameters": [PREFER, CANARY]},
)
async def upsample(
    request: Request, query: Annotated[UpsampleQuery, Query()], service: ServiceDep
) -> Response:
    """Upsample the point cloud in the body: R times as many points, each with a normal."""
    deadline = Deadline(preferred_wait(request.headers), service.settings.deadline_s)
    with ExitStack() as held:
        try:
            choice = choose_format(request.headers.get("accept"), query.format)
            # Any share of the requests will do; nobody gains by guessing the next one.
            chance = random.random()  # noqa: S311
            model = service.models.choose(query.model, wants_canary(request.headers), chance)
            result, output = await serve(
                request, service, choice, query.for_model(), model, deadline, held
            )
        except (ProblemError, CloudError) as error:
            service.telemetry.rejected.labels(error.code).inc()
            raise
        count_run(service.telemetry, result, model.described)
        for seconds, patches in result.batches:
            service.admission.patch_cost.add(seconds, patches)
        headers = response_headers(result, output, model.described)
        if deadline.wait is not None:
            headers["Preference-Applied"] = f"wait={deadline.wait}"
        return SpoolResponse(result, headers, held.pop_all())
