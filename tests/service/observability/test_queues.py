# SPDX-License-Identifier: Apache-2.0
"""The queues of requests and of jobs are told apart."""

from pathlib import Path

import pytest

from pugeo_service.app import create_service
from pugeo_service.models import Models
from pugeo_service.settings import Settings


def test_jobs_do_not_fill_the_queue_of_requests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each queue has its own patches and capacity, although a job may exceed its capacity."""
    monkeypatch.setenv("PUGEO_JOBS_DIR", str(tmp_path))
    settings = Settings(engine="inline", model="fast", queue_patches=10)
    service = create_service(settings, Models(settings))

    def told(name: str) -> dict[str, float | None]:
        value = service.telemetry.registry.get_sample_value
        return {queue: value(name, {"queue": queue}) for queue in ("requests", "jobs")}

    with service.jobs.admission.reserve() as job, service.admission.reserve() as request:
        job.admit(50)
        request.admit(3)
        assert told("pugeo_queue_patches") == {"requests": 3, "jobs": 50}
        assert told("pugeo_queue_capacity_patches") == {"requests": 10, "jobs": 10}
    assert told("pugeo_queue_patches") == {"requests": 0, "jobs": 0}
