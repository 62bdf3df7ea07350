# SPDX-License-Identifier: Apache-2.0
"""Probes. They ask no worker anything, so a busy engine cannot make the service look dead."""

from typing import Annotated, Literal

from fastapi import APIRouter
from pydantic import BaseModel, Field

from pugeo_service import __version__
from pugeo_service.container import ServiceDep
from pugeo_service.problems import ProblemError, problem_responses

__all__ = ["router"]

router = APIRouter(tags=["health"])
_WHY = {
    "draining": "The service is shutting down.",
    "no_worker": "No worker is warm yet.",
    "queue_full": "The queue is full.",
}


class Alive(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Ready(BaseModel):
    """A request would be served now."""

    status: Literal["ready"] = "ready"


class Health(BaseModel):
    """The state of the service in numbers."""

    status: Literal["ready", "not_ready"]
    reason: Annotated[
        Literal["draining", "no_worker", "queue_full"] | None, Field(description="why not ready")
    ]
    version: str
    model: str
    workers: Annotated[int, Field(description="worker processes that are warm")]
    workers_expected: Annotated[int | None, Field(description="null where they run elsewhere")]
    queue_patches: int
    queue_capacity_patches: int
    queue_requests: int


@router.get("/health/live", operation_id="health_live")
async def live() -> Alive:
    """Say that the process answers; restart it where it does not."""
    return Alive()


@router.get("/health/ready", operation_id="health_ready", responses=problem_responses(503))
async def ready(service: ServiceDep) -> Ready:
    """Say whether to send requests here: a warm worker, room in the queue, not shutting down."""
    reason = service.not_ready_because
    if reason is not None:
        raise ProblemError(503, reason, _WHY[reason], retry_after=2)
    return Ready()


@router.get("/health", operation_id="health")
async def health(service: ServiceDep) -> Health:
    """Say how the service is, in numbers; always 200."""
    status, admission = service.engine.status, service.admission
    reason = service.not_ready_because
    return Health(
        status="not_ready" if reason else "ready",
        reason=reason,
        version=__version__,
        model=str(service.card["name"]),
        workers=status.workers,
        workers_expected=status.expected,
        queue_patches=admission.patches,
        queue_capacity_patches=admission.max_patches,
        queue_requests=admission.requests,
    )
