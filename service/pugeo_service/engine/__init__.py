# SPDX-License-Identifier: Apache-2.0
"""Where the work is done: a graph of small tasks for each request, run by worker processes."""

from pugeo_service.engine.engine import Engine
from pugeo_service.engine.errors import DiskError, EngineLostError, WorkerLostError
from pugeo_service.engine.messages import Order, Outcome, Readable

__all__ = [
    "DiskError",
    "Engine",
    "EngineLostError",
    "Order",
    "Outcome",
    "Readable",
    "WorkerLostError",
]
