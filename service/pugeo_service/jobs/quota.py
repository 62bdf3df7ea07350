# SPDX-License-Identifier: Apache-2.0
"""Whether there is room for another job: in all, and in the share of its owner."""

from dataclasses import dataclass

from pugeo_service.admission.fair_share import check_share
from pugeo_service.jobs.client_queries import Usage
from pugeo_service.problems import ProblemError

__all__ = ["Room"]

# How long jobs take nobody knows before they have begun.
_RETRY_S = 30.0


@dataclass(frozen=True)
class Room:
    """What jobs may take up.

    Attributes:
        jobs: that wait or run.
        bytes: of inputs of these, and of results that are kept.
    """

    jobs: int
    bytes: int

    def check(self, owner: str, size: int, taken: Usage, mine: Usage) -> None:
        """Refuse a job that there is no room for.

        Args:
            owner: whose share it counts to; ``""`` for nobody's, where no keys are asked for.
            size: bytes of its input, or 0 while that is not known.
            taken: what all jobs take up.
            mine: what those of its owner do.

        Raises:
            ProblemError: 503 where all together take up too much, 429 where the owner does.
        """
        size = max(1, size)
        if taken.active >= self.jobs or taken.bytes + size > self.bytes:
            raise self._full(taken)
        if not owner:
            return
        for unit, held, wanted, free in (
            ("jobs", mine.active, 1, self.jobs - taken.active),
            ("bytes", mine.bytes, size, self.bytes - taken.bytes),
        ):
            check_share(
                unit,
                "the room for jobs",
                held=held,
                elsewhere=held,
                wanted=wanted,
                free=free,
                wait=lambda _: _RETRY_S,
            )

    def _full(self, taken: Usage) -> ProblemError:
        detail = "There is no room for another job; try again after the time in Retry-After."
        fields = {
            "active_jobs": taken.active,
            "capacity_jobs": self.jobs,
            "bytes": taken.bytes,
            "capacity_bytes": self.bytes,
        }
        return ProblemError(503, "jobs_full", detail, retry_after=_RETRY_S, fields=fields)
