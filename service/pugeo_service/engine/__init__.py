# SPDX-License-Identifier: Apache-2.0
"""Where the work is done: a graph of small tasks for each request, run by worker processes."""

from pugeo_service.engine.engine import Engine
from pugeo_service.engine.errors import DiskFailed, EngineLost, WorkerLost
from pugeo_service.engine.messages import Order, Outcome, Readable

__all__ = ["DiskFailed", "Engine", "EngineLost", "Order", "Outcome", "Readable", "WorkerLost"]
