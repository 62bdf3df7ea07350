# SPDX-License-Identifier: Apache-2.0
"""Container of all parts that routes share."""

from dataclasses import dataclass
from typing import Annotated, Literal, cast

from fastapi import Depends, Request

from pugeo_service.admission.admission import Admission
from pugeo_service.engine import Engine
from pugeo_service.jobs import JobManager
from pugeo_service.keys import Keys
from pugeo_service.models import Models
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.settings import Settings

__all__ = ["Service", "ServiceDep"]


@dataclass(frozen=True)
class Service:
    """One running service.

    Attributes:
        settings: settings of the process.
        engine: runs requests.
        admission: the queue of requests.
        jobs: background jobs.
        keys: API keys.
        telemetry: metrics.
        models: models by name.
    """

    settings: Settings
    engine: Engine
    admission: Admission
    jobs: JobManager
    keys: Keys
    telemetry: Telemetry
    models: Models

    def drain(self) -> None:
        """Refuse new requests; admitted ones are finished, running jobs are queued again."""
        self.admission.draining = True
        self.jobs.drain()

    @property
    def not_ready_because(self) -> Literal["draining", "no_worker", "queue_full"] | None:
        """Reason for which a request would be refused now, or ``None``."""
        if self.admission.draining:
            return "draining"
        if self.engine.status.workers == 0:
            return "no_worker"
        return None if self.admission.has_room else "queue_full"


def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


ServiceDep = Annotated[Service, Depends(_service)]
