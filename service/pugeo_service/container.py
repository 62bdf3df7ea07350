# SPDX-License-Identifier: Apache-2.0
"""What the routes share."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, cast

from fastapi import Depends, Request

from pugeo_service.admission.admission import Admission
from pugeo_service.engine import Engine
from pugeo_service.jobs import Jobs
from pugeo_service.keys import Keys
from pugeo_service.observability.telemetry import Telemetry
from pugeo_service.settings import Settings

__all__ = ["Service", "ServiceDep"]


@dataclass(frozen=True)
class Service:
    """One running service.

    Attributes:
        settings: as started.
        engine: runs orders.
        admission: the queue.
        jobs: requests that outlive their connection.
        keys: who may come in.
        telemetry: metrics.
        card: the model's card.
    """

    settings: Settings
    engine: Engine
    admission: Admission
    jobs: Jobs
    keys: Keys
    telemetry: Telemetry
    card: dict[str, Any]

    def drain(self) -> None:
        """Let nothing more in: what waits for an answer is finished, jobs are put back."""
        self.admission.draining = True
        self.jobs.drain()

    @property
    def not_ready_because(self) -> Literal["draining", "no_worker", "queue_full"] | None:
        """Why a request would not be served now, or ``None``."""
        if self.admission.draining:
            return "draining"
        if self.engine.status.workers == 0:
            return "no_worker"
        return None if self.admission.has_room else "queue_full"


def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


ServiceDep = Annotated[Service, Depends(_service)]
