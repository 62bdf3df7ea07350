# SPDX-License-Identifier: Apache-2.0
"""Quota of jobs: capacity of the service and fair shares of owners."""

from dataclasses import dataclass

from pugeo_service.admission.fair_share import check_share
from pugeo_service.jobs.repository import JobUsage
from pugeo_service.problems import ProblemError

__all__ = ["Quota"]

_JOBS, _BYTES = "PUGEO_JOBS_QUEUE", "PUGEO_JOBS_BYTES"
# The time of queued jobs is unknown, so this is a fixed estimate.
_RETRY_S = 30.0


@dataclass(frozen=True)
class Quota:
    """Capacity for jobs.

    Attributes:
        jobs: number of queued and running jobs.
        bytes: bytes of their inputs and of stored results.
    """

    jobs: int
    bytes: int

    def check(self, owner: str, size: int, total: JobUsage, owned: JobUsage) -> None:
        """Refuse a job that exceeds the capacity or the share of its owner.

        Args:
            owner: name of the API key; ``""`` without keys, where no shares apply.
            size: bytes of the input, or 0 if unknown.
            total: use by all jobs.
            owned: use by the jobs of the owner.

        Raises:
            ProblemError: 413 for an input that is larger than the whole capacity, 503 for the
                capacity, 429 for the share.
        """
        size = max(1, size)
        if size > self.bytes:
            raise _too_large(size, self.bytes)
        if total.active >= self.jobs or total.bytes + size > self.bytes:
            raise self._full(total)
        if not owner:
            return
        for unit, setting, held, wanted, free in (
            ("jobs", _JOBS, owned.active, 1, self.jobs - total.active),
            ("bytes", _BYTES, owned.bytes, size, self.bytes - total.bytes),
        ):
            check_share(
                unit,
                "the capacity for jobs",
                setting,
                held=held,
                held_elsewhere=held,
                wanted=wanted,
                free=free,
                retry_after=lambda _: _RETRY_S,
            )

    def _full(self, total: JobUsage) -> ProblemError:
        setting = _JOBS if total.active >= self.jobs else _BYTES
        detail = (
            f"The capacity for jobs ({setting}) is exhausted; try again after the time in "
            "Retry-After."
        )
        fields = {
            "setting": setting,
            "active_jobs": total.active,
            "capacity_jobs": self.jobs,
            "bytes": total.bytes,
            "capacity_bytes": self.bytes,
        }
        return ProblemError(503, "jobs_full", detail, retry_after=_RETRY_S, fields=fields)


def _too_large(size: int, limit: int) -> ProblemError:
    detail = f"The input has {size:,} bytes; all jobs together may have {limit:,} ({_BYTES})."
    fields = {"limit": limit, "value": size, "setting": _BYTES}
    return ProblemError(413, "body_too_large", detail, fields=fields)
