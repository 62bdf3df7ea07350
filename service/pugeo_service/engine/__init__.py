# SPDX-License-Identifier: Apache-2.0
"""The engine: each request is a graph of small tasks that worker processes run."""

from pugeo_service.engine.engine import Engine
from pugeo_service.engine.errors import (
    DiskError,
    EngineLostError,
    EngineStartError,
    WorkerLostError,
    WrongWeightsError,
)
from pugeo_service.engine.messages import BodyReader, ModelId, RunRequest, RunResult

__all__ = [
    "BodyReader",
    "DiskError",
    "Engine",
    "EngineLostError",
    "EngineStartError",
    "ModelId",
    "RunRequest",
    "RunResult",
    "WorkerLostError",
    "WrongWeightsError",
]
