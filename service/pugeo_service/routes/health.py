# SPDX-License-Identifier: Apache-2.0
"""Probes. They do not call the workers, so a busy engine does not make them fail."""

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
    "no_worker": "No worker is ready yet.",
}


class Alive(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Ready(BaseModel):
    """A request would be admitted now."""

    status: Literal["ready"] = "ready"


class Health(BaseModel):
    """State of the service."""

    status: Literal["ready", "not_ready"]
    reason: Annotated[
        Literal["draining", "no_worker", "queue_full"] | None,
        Field(description="reason if not ready"),
    ]
    version: str
    model: str
    workers: Annotated[int, Field(description="worker processes that are ready")]
    workers_expected: Annotated[int | None, Field(description="null for an external cluster")]
    queue_patches: int
    queue_capacity_patches: int
    queue_requests: int


@router.get("/health/live", operation_id="health_live", responses=problem_responses(422))
async def live() -> Alive:
    """Confirm that the process answers; an orchestrator restarts it otherwise."""
    return Alive()


@router.get("/health/ready", operation_id="health_ready", responses=problem_responses(422, 503))
async def ready(service: ServiceDep) -> Ready:
    """Confirm that requests are admitted: a worker is ready, the queue has room, no shutdown."""
    reason = service.not_ready_because
    if reason == "queue_full":
        raise service.admission.queue_full(1)
    if reason is not None:
        raise ProblemError(503, reason, _WHY[reason], retry_after=2)
    return Ready()


@router.get("/health", operation_id="health", responses=problem_responses(422))
async def health(service: ServiceDep) -> Health:
    """Return the state of the service; the status is always 200."""
    status, admission = service.engine.status, service.admission
    reason = service.not_ready_because
    return Health(
        status="not_ready" if reason else "ready",
        reason=reason,
        version=__version__,
        model=service.models.default.name,
        workers=status.workers,
        workers_expected=status.expected,
        queue_patches=admission.patches,
        queue_capacity_patches=admission.max_patches,
        queue_requests=admission.requests,
    )
