# SPDX-License-Identifier: Apache-2.0
"""``GET /models``: the cards of the models, with their measured quality."""

from typing import Annotated, Any

from fastapi import APIRouter
from pydantic import BaseModel, Field

from pugeo_service.container import ServiceDep
from pugeo_service.problems import problem_responses

__all__ = ["router"]

router = APIRouter(prefix="/models", tags=["models"])


class Canary(BaseModel):
    """A model that a share of the requests gets that name none."""

    name: str
    share: Annotated[float, Field(description="0 to 1")]


class ModelList(BaseModel):
    """All models of the service."""

    models: Annotated[list[dict[str, Any]], Field(description="model cards, the default first")]
    default: str
    canary: Canary | None


@router.get("", operation_id="list_models", responses=problem_responses(422))
async def list_models(service: ServiceDep) -> ModelList:
    """List the cards of all models of this service, the default first."""
    canary = service.models.canary
    return ModelList(
        models=[model.card for model in service.models],
        default=service.models.default.name,
        canary=None if canary is None else Canary(name=canary[0], share=canary[1]),
    )


@router.get("/{name}", operation_id="get_model", responses=problem_responses(404, 422))
async def get_model(name: str, service: ServiceDep) -> dict[str, Any]:
    """Return one card: version, sha256, ratio range, training data, measured quality."""
    return service.models.named(name, 404).card
