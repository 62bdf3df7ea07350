# SPDX-License-Identifier: Apache-2.0
"""Who is let in: a queue bounded in patches, bytes and requests, and shared among its owners.

Patches are the unit because a request of a million points costs a thousand times one of a
thousand points; a bound on requests alone would bound neither time nor memory.
"""

import functools
import itertools
from collections import defaultdict
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from pugeo_service.admission.fair_share import check_share
from pugeo_service.admission.throughput import DrainRate, Pace
from pugeo_service.engine.scheduling import LARGE_PATCHES
from pugeo_service.problems import ProblemError

__all__ = ["Admission", "Hold"]

_LONGEST_RETRY_S = 120.0


@dataclass
class Totals:
    """What is taken up: by one request, by one owner, or by all together."""

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
        self.pace = Pace()
        self.totals = Totals()
        self.owners: defaultdict[str, Totals] = defaultdict(Totals)
        self.entered: dict[Hold, None] = {}

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

    def hold(self, owner: str = "") -> "Hold":
        """Open an account for a request that begins.

        Args:
            owner: whose share it counts to; ``""`` for nobody's, where no keys are asked for.

        Raises:
            ProblemError: 503 while draining or where there is no room for even the smallest, 429
                where the owner holds its share of requests already.
        """
        self.check_draining()
        if not self.has_room:
            raise self.full(1)
        hold = Hold(self, owner)
        hold.check_share(Totals(requests=1))
        return hold

    def check_draining(self) -> None:
        """Raise a problem, 503, while the service shuts down."""
        if self.draining:
            detail = "The service is shutting down; another one may take the request."
            raise ProblemError(503, "draining", detail, retry_after=5)

    def full(self, patches: int) -> ProblemError:
        """Return the refusal of a request of ``patches``, with the time until there is room."""
        now = self.totals
        excess = now.patches + patches - self.max_patches
        # Where requests or bytes are short and not patches, one request must end first.
        wait = self.rate.seconds(excess if excess > 0 else now.patches / max(1, now.requests))
        detail = "The queue is full; try again after the time in Retry-After."
        fields = {
            "queued_patches": now.patches,
            "capacity_patches": self.max_patches,
            "queued_requests": now.requests,
            "capacity_requests": self.max_requests,
        }
        return ProblemError(503, "queue_full", detail, retry_after=_bounded(wait), fields=fields)

    def free(self) -> Totals:
        """Return what is not taken up; never less than 0."""
        return Totals(
            max(0, self.max_patches - self.totals.patches),
            max(0, self.max_bytes - self.totals.bytes),
            max(0, self.max_requests - self.totals.requests),
        )


class Hold:
    """What one request takes up, given back on leaving the ``with`` block."""

    def __init__(self, admission: Admission, owner: str) -> None:
        self._admission = admission
        self._owner = owner
        self._over = False
        self.mine = Totals()
        self.large = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over = True
        admission, was_in = self._admission, self.mine.requests
        self._take(Totals(-self.mine.patches, -self.mine.bytes, -self.mine.requests))
        admission.entered.pop(self, None)
        if admission.owners.get(self._owner) == Totals():
            del admission.owners[self._owner]
        if was_in and admission.requests == 0:
            admission.rate.stop()

    def grow(self, size: int) -> None:
        """Account for ``size`` further bytes of the body.

        Raises:
            ProblemError: 503 where all requests together hold too many, 429 where the owner does.
        """
        total = self._admission.totals
        others = total.bytes - self.mine.bytes
        if others and total.bytes + size > self._admission.max_bytes:
            raise self._admission.full(1)
        self.check_share(Totals(bytes=size))
        self._take(Totals(bytes=size))

    def enter(self, patches: int) -> None:
        """Join the queue with an estimate of the patches (>= 1).

        Raises:
            ProblemError: 503 where there is no room, 429 where there is and the owner has its share.
        """
        admission, total = self._admission, self._admission.totals
        admission.check_draining()
        crowded = total.requests and total.patches + patches > admission.max_patches
        if crowded or total.requests >= admission.max_requests:
            raise admission.full(patches)
        self.check_share(Totals(patches=patches, requests=1))
        if total.requests == 0:
            admission.rate.start()
        admission.entered[self] = None
        self.large = patches >= LARGE_PATCHES
        self._take(Totals(patches=patches, requests=1))

    def resize(self, patches: int) -> None:
        """Replace the estimate by what is known now to remain."""
        # The engine's thread may have counted them just before it learned of the end.
        if self._over:
            return
        self._take(Totals(patches=patches - self.mine.patches))
        self.large = patches >= LARGE_PATCHES

    def finish(self, patches: int) -> None:
        """Count ``patches`` as done."""
        if not self._over:
            self._take(Totals(patches=-min(patches, self.mine.patches)))
        self._admission.rate.add(patches)

    def check_share(self, more: Totals) -> None:
        """Refuse what would give the owner more than is left for everybody else.

        An owner's only request is never its own obstacle, however large.

        Raises:
            ProblemError: 429.
        """
        if not self._owner:
            return
        free = self._admission.free()
        held = self._admission.owners.get(self._owner, Totals())
        for unit in ("patches", "bytes", "requests"):
            check_share(
                unit,
                "the queue",
                held=getattr(held, unit),
                elsewhere=getattr(held, unit) - getattr(self.mine, unit),
                wanted=getattr(more, unit),
                free=getattr(free, unit),
                wait=functools.partial(self._until_returned, unit),
            )

    def check_deadline(self, left: float, workers: int, *, sized: bool) -> None:
        """Refuse at once what cannot be done in time.

        Small requests wait for those that came first and have no more to do. Large ones wait for
        large ones that came first, but as many as there are workers are begun, and all but one of
        them may end after this one.
        All times are lower bounds, the network's part alone: to refuse what might have been
        served is worse than to give up late.

        Args:
            left: seconds until the client stops waiting.
            workers: how many share the work.
            sized: whether the patches are counted; an estimate counts only those of others.

        Raises:
            ProblemError: 503 where the queue is the cause, 504 where the cloud itself takes longer.
        """
        mine = self.mine.patches
        earlier = itertools.takewhile(lambda other: other is not self, self._admission.entered)
        alike = sorted(other.mine.patches for other in earlier if other.large is self.large)
        if self.large:
            ahead = sum(alike[: max(0, len(alike) - workers + 1)])
        else:
            ahead = sum(patches for patches in alike if patches <= mine)
        alone = self._admission.pace.least_seconds(mine, workers) if sized else 0.0
        before = self._admission.pace.least_seconds(ahead, workers)
        if alone > left:
            detail = (
                f"This cloud takes {alone:.0f} s at the very least, and there are {left:.0f} s "
                "left. Ask for a longer wait, or for no limit."
            )
            fields = {"patches": mine, "seconds_left": round(left, 1)}
            raise ProblemError(504, "deadline_too_short", detail, retryable=False, fields=fields)
        if before + alone > left:
            detail = (
                f"Requests that come first take {before:.0f} s at the very least, and there are "
                f"{left:.0f} s left."
            )
            fields = {"patches_ahead": ahead, "seconds_left": round(left, 1)}
            wait = _bounded(before + alone - left)
            raise ProblemError(503, "deadline_unmeetable", detail, retry_after=wait, fields=fields)

    def _take(self, more: Totals) -> None:
        for account in (self.mine, self._admission.totals, self._admission.owners[self._owner]):
            account.patches += more.patches
            account.bytes += more.bytes
            account.requests += more.requests

    def _until_returned(self, unit: str, amount: float) -> float:
        """Guess the seconds until the owner has given back so much."""
        admission = self._admission
        mine, total = admission.owners[self._owner], admission.totals
        patches = amount if unit == "patches" else mine.patches / max(1, mine.requests)
        # The workers are shared with the others' patches.
        wait = admission.rate.seconds(patches * max(1, total.patches) / max(1, mine.patches))
        return _bounded(wait)


def _bounded(seconds: float) -> float:
    return min(_LONGEST_RETRY_S, max(1.0, seconds))
