# SPDX-License-Identifier: Apache-2.0
"""``GET /metrics`` for Prometheus."""

from fastapi import APIRouter
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from starlette.responses import Response

from pugeo_service.container import ServiceDep
from pugeo_service.problems import problem_responses

__all__ = ["router"]

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    operation_id="metrics",
    response_class=Response,
    responses={
        200: {"content": {"text/plain": {"schema": {"type": "string"}}}},
        **problem_responses(422),
    },
)
async def metrics(service: ServiceDep) -> Response:
    """Return all metrics in Prometheus's text format."""
    return Response(
        generate_latest(service.telemetry.registry), headers={"Content-Type": CONTENT_TYPE_LATEST}
    )
