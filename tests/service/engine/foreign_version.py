# SPDX-License-Identifier: Apache-2.0
"""A preload for workers of tests that claim to be of another version."""

from typing import Any

from pugeo_service.engine.worker import VERSION_METRIC


def dask_setup(worker: Any) -> None:
    """Offer the resources of version 0.0.9."""
    for name in ("core-0.0.9", "quick-0.0.9"):
        worker.state.total_resources[name] = worker.state.available_resources[name] = 1
    worker.metrics[VERSION_METRIC] = lambda _worker: "0.0.9"
