# SPDX-License-Identifier: Apache-2.0
"""The workers that a front can use, from the records and events of the scheduler."""

from collections.abc import Collection, Mapping
from typing import Any

import structlog

from pugeo_service import __version__
from pugeo_service.engine.backend import CORE
from pugeo_service.engine.worker import VERSION_METRIC
from pugeo_service.engine.worker_use import worker_name, worker_uses
from pugeo_service.observability.telemetry import WorkerUse

__all__ = ["EVENTS", "Membership"]

_log = structlog.stdlib.get_logger("pugeo.engine")

EVENTS = "all"
"""Topic on which Dask's scheduler tells what happens to workers."""


class Membership:
    """Workers by name, their use, and the number of those lost.

    Attributes:
        names: of the workers that could run a task now.
        uses: memory and processor time of each worker.
        memory: bytes that each worker may use; ``None`` if they are unlimited or unknown.
        lost: workers that ended unexpectedly.
    """

    def __init__(self) -> None:
        self.names: frozenset[str] = frozenset()
        self.uses: tuple[WorkerUse, ...] = ()
        self.memory: int | None = None
        self.lost = 0
        # Workers of another version, by address; they are told of once.
        self._foreign: frozenset[str] = frozenset()

    def see(self, records: Mapping[str, Mapping[str, Any]], hanging: Collection[str]) -> None:
        """Take over the scheduler's records of all workers, by address.

        Args:
            records: of each worker that the scheduler has.
            hanging: addresses of those that give no sign.
        """
        self._log_other_versions(records)
        self.names = frozenset(
            worker_name(address, record)
            for address, record in records.items()
            # Without such a core it would never be given work: see `worker.one_at_a_time`.
            if record["status"] == "running" and CORE in record["resources"]
            if address not in hanging
        )
        limits = [record.get("memory_limit") for record in records.values()]
        self.memory = min((limit for limit in limits if limit), default=None)
        self.uses = worker_uses(records)

    def forget(self) -> None:
        """Forget all workers, because their scheduler is gone."""
        self.names, self.uses = frozenset(), ()

    def on_event(self, event: tuple[float, Any]) -> None:
        """Count a worker that the scheduler has lost.

        A worker that is missing among the records may have left in order: it was retired, as by a
        scale-down or an upgrade. Only the scheduler knows which.
        """
        told = event[1]
        if not isinstance(told, Mapping) or told.get("action") != "remove-worker":
            return
        if not told["expected"] and told["worker"] not in self._foreign:
            self.lost += 1

    def _log_other_versions(self, records: Mapping[str, Mapping[str, Any]]) -> None:
        """Log each worker of another version once; tasks need resources that it does not have."""
        foreign = {
            address: record.get("metrics", {}).get(VERSION_METRIC, "of unknown version")
            for address, record in records.items()
            if CORE not in record["resources"]
        }
        for address in foreign.keys() - self._foreign:
            _log.error(
                f"worker {address} runs pugeo {foreign[address]}, this service {__version__}: it "
                "is not used"
            )
        self._foreign = frozenset(foreign)
