# SPDX-License-Identifier: Apache-2.0
"""``POST /preview``: the surface of a cloud as a mesh, to look at."""

from contextlib import ExitStack
from typing import Any

from fastapi import APIRouter, Request, Response

from pugeo_model.errors import CloudError
from pugeo_service.admission.deadline import Deadline
from pugeo_service.container import ServiceDep
from pugeo_service.http.negotiation import OUTPUT_FORMATS, OutputChoice
from pugeo_service.http.prefer import preferred_wait
from pugeo_service.http.responses import SpoolResponse, response_headers
from pugeo_service.problems import ProblemError, problem_responses
from pugeo_service.routes.clouds import BINARY, BODY, HEADERS
from pugeo_service.routes.serving import serve
from pugeo_service.routes.upsample import PREFER
from pugeo_service.runs import count_run

__all__ = ["router"]

router = APIRouter(tags=["upsample"])

_MESH = OUTPUT_FORMATS["ply"]
_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A binary PLY file with vertices and faces, in the frame of the cloud.",
        "headers": HEADERS,
        "content": {_MESH.media_type: BINARY},
    },
    **problem_responses(400, 401, 408, 413, 415, 422, 429, 500, 501, 503, 504),
}


@router.post(
    "/preview",
    operation_id="preview",
    response_class=Response,
    responses=_RESPONSES,
    openapi_extra={**BODY, "parameters": [PREFER]},
)
async def preview(request: Request, service: ServiceDep) -> Response:
    """Reconstruct the surface of the point cloud in the body, as a triangle mesh to look at.

    A cloud of more than PUGEO_PREVIEW_POINTS points is thinned to so many. Points without normals
    get them from the network first.
    """
    deadline = Deadline(preferred_wait(request.headers), service.settings.deadline_s)
    most, model = service.settings.preview_points, service.models.default
    with ExitStack() as held:
        try:
            result, _ = await serve(
                request, service, OutputChoice((_MESH,)), {"ratio": 1.0}, model, deadline, held,
                surface_points=most,
            )  # fmt: skip
        except (ProblemError, CloudError) as error:
            service.telemetry.rejected.labels(error.code).inc()
            raise
        except ModuleNotFoundError as error:
            detail = (
                "This service has no library for surfaces; its operator installs it with the "
                "extra surfaces."
            )
            raise ProblemError(501, "no_surfaces", detail, retryable=False) from error
        count_run(service.telemetry, result, model.described)
        headers = response_headers(result, _MESH, model.described)
        if deadline.wait is not None:
            headers["Preference-Applied"] = f"wait={deadline.wait}"
        return SpoolResponse(result, headers, held.pop_all())
