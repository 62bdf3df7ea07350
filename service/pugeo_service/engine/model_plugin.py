# SPDX-License-Identifier: Apache-2.0
"""Plugin of Dask that carries weights to all workers, also to those that join later."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from distributed.diagnostics.plugin import WorkerPlugin

from pugeo_service.engine import model_store

if TYPE_CHECKING:
    from pugeo_model.weights import Weights

__all__ = ["ModelPlugin"]


class ModelPlugin(WorkerPlugin):
    """Gives weights to a worker before it gets its first task.

    Args:
        weights: bytes and card.
        front: name of the front that sends them; each front removes its own.
    """

    def __init__(self, weights: Weights, front: str) -> None:
        self._weights = weights
        self.name = self.name_of(weights.card["sha256"], front)

    @staticmethod
    def name_of(sha256: str, front: str) -> str:
        """Return the name by which the scheduler knows the plugin."""
        return f"pugeo-model-{front}-{sha256}"

    def setup(self, worker: Any) -> None:
        """Install the weights."""
        del worker
        model_store.install(self._weights)

    def teardown(self, worker: Any) -> None:
        """Remove the weights."""
        del worker
        model_store.remove(self._weights.card["sha256"])
