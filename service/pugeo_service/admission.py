# SPDX-License-Identifier: Apache-2.0
"""Who is let in: a queue bounded in patches, bytes and requests.

Patches are the unit because a request of a million points costs a thousand times one of a
thousand points; a bound on requests alone would bound neither time nor memory.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from pugeo_service.problems import Problem

__all__ = ["Admission", "DrainRate", "Hold"]

_HALF_LIFE_S = 20.0
_LONGEST_RETRY_S = 120.0


class DrainRate:
    """Patches finished per second of work, as a moving average that forgets by half in 20 s.

    Idle time does not count: an idle service is not a slow one.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._patches = 0.0
        self._seconds = 0.0
        self._since: float | None = None

    def start(self) -> None:
        """Work begins after idleness."""
        self._since = self._clock()

    def stop(self) -> None:
        """The queue ran empty."""
        self.add(0)
        self._since = None

    def add(self, patches: int) -> None:
        """Count patches that were just finished."""
        now = self._clock()
        elapsed = 0.0 if self._since is None else now - self._since
        self._since = now
        kept = 0.5 ** (elapsed / _HALF_LIFE_S)
        self._patches = self._patches * kept + patches
        self._seconds = self._seconds * kept + elapsed

    @property
    def per_second(self) -> float | None:
        """Patches per second, or ``None`` before anything was measured."""
        return self._patches / self._seconds if self._patches and self._seconds else None


@dataclass
class Totals:
    """What is taken up: by one request, or by all together."""

    patches: int = 0
    bytes: int = 0
    requests: int = 0


class Admission:
    """The bounded queue. All its methods belong to the event loop of the front.

    Args:
        max_patches: patches admitted and not yet finished. One request larger than that is let
            in when nothing else waits, else it could never be served.
        max_bytes: bytes of bodies held.
        max_requests: requests admitted and not yet finished.
    """

    def __init__(self, max_patches: int, max_bytes: int, max_requests: int) -> None:
        self.max_patches = max_patches
        self.max_bytes = max_bytes
        self.max_requests = max_requests
        self.draining = False
        self.rate = DrainRate()
        self.totals = Totals()

    @property
    def patches(self) -> int:
        """Patches admitted and not yet finished."""
        return self.totals.patches

    @property
    def bytes(self) -> int:
        """Bytes of bodies held."""
        return self.totals.bytes

    @property
    def requests(self) -> int:
        """Requests admitted and not yet finished."""
        return self.totals.requests

    @property
    def has_room(self) -> bool:
        """Whether a small request would be let in now."""
        return (
            not self.draining
            and self.totals.requests < self.max_requests
            and self.totals.patches < self.max_patches
            and self.totals.bytes < self.max_bytes
        )

    def hold(self) -> "Hold":
        """Open an account for a request that begins.

        Raises:
            Problem: 503 while draining or where there is no room for even the smallest.
        """
        if self.draining:
            detail = "The service is shutting down; another one may take the request."
            raise Problem(503, "draining", detail, retry_after=5)
        if not self.has_room:
            raise self.full(1)
        return Hold(self)

    def full(self, patches: int) -> Problem:
        """Return the refusal of a request of ``patches``, with the time until there is room."""
        excess = max(1, self.totals.patches + patches - self.max_patches)
        rate = self.rate.per_second
        # Nothing measured yet: a patch takes some tens of milliseconds on one processor.
        wait = min(_LONGEST_RETRY_S, excess / (rate or 20.0))
        detail = "The queue is full; try again after the time in Retry-After."
        fields = {
            "queued_patches": self.totals.patches,
            "capacity_patches": self.max_patches,
            "queued_requests": self.totals.requests,
            "capacity_requests": self.max_requests,
        }
        return Problem(503, "queue_full", detail, retry_after=wait, fields=fields)


class Hold:
    """What one request takes up, given back on leaving the ``with`` block."""

    def __init__(self, admission: Admission) -> None:
        self._admission = admission
        self._mine = Totals()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        total = self._admission.totals
        total.patches -= self._mine.patches
        total.bytes -= self._mine.bytes
        total.requests -= self._mine.requests
        if self._mine.requests and total.requests == 0:
            self._admission.rate.stop()
        self._mine = Totals()

    def grow(self, size: int) -> None:
        """Account for ``size`` further bytes of the body.

        Raises:
            Problem: 503 where all requests together hold too many.
        """
        total = self._admission.totals
        others = total.bytes - self._mine.bytes
        if others and total.bytes + size > self._admission.max_bytes:
            raise self._admission.full(1)
        total.bytes += size
        self._mine.bytes += size

    def enter(self, patches: int) -> None:
        """Join the queue with an estimate of the patches (>= 1).

        Raises:
            Problem: 503 where there is no room.
        """
        total = self._admission.totals
        if self._admission.draining:
            self._admission.hold()
        crowded = total.requests and total.patches + patches > self._admission.max_patches
        if crowded or total.requests >= self._admission.max_requests:
            raise self._admission.full(patches)
        if total.requests == 0:
            self._admission.rate.start()
        total.requests += 1
        self._mine.requests = 1
        self.resize(patches)

    def resize(self, patches: int) -> None:
        """Replace the estimate by what is known now to remain."""
        self._admission.totals.patches += patches - self._mine.patches
        self._mine.patches = patches

    def finish(self, patches: int) -> None:
        """Count ``patches`` as done."""
        done = min(patches, self._mine.patches)
        self.resize(self._mine.patches - done)
        self._admission.rate.add(patches)
