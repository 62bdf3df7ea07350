# SPDX-License-Identifier: Apache-2.0
"""``GET /models``: the card of the model, with its measured quality."""

from typing import Any

from fastapi import APIRouter

from pugeo_service.container import ServiceDep
from pugeo_service.problems import ProblemError, problem_responses

__all__ = ["router"]

router = APIRouter(prefix="/models", tags=["models"])


@router.get("", operation_id="list_models", responses=problem_responses(422))
async def list_models(service: ServiceDep) -> dict[str, list[dict[str, Any]]]:
    """List the cards of all models of this service."""
    return {"models": [service.card]}


@router.get("/{name}", operation_id="get_model", responses=problem_responses(404, 422))
async def get_model(name: str, service: ServiceDep) -> dict[str, Any]:
    """Return one card: version, sha256, ratio range, training data, measured quality."""
    if name != service.card["name"]:
        detail = f"There is no model {name[:80]!r}; this service runs {service.card['name']!r}."
        raise ProblemError(
            404, "unknown_model", detail, fields={"available": [service.card["name"]]}
        )
    return service.card
