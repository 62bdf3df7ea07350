# SPDX-License-Identifier: Apache-2.0
"""Admission control: a queue bounded in patches, bytes and requests, shared fairly among owners.

The main unit is the patch, because a request of a million points costs a thousand times as much as
one of a thousand points. A bound on requests alone would limit neither time nor memory.
"""

import functools
import itertools
from collections import defaultdict
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from pugeo_service.admission.fair_share import check_share
from pugeo_service.admission.throughput import PatchCost, Throughput
from pugeo_service.engine.scheduling import LARGE_PATCHES
from pugeo_service.problems import ProblemError, draining

__all__ = ["Admission", "QueueUsage", "Reservation"]

_MAX_RETRY_S = 120.0


@dataclass
class QueueUsage:
    """Part of the queue that is in use: by one request, by one owner, or in total."""

    patches: int = 0
    bytes: int = 0
    requests: int = 0


class Admission:
    """The bounded queue. All methods must be called in the event loop of the front.

    Args:
        max_patches: patches admitted and not yet finished. A request larger than this is admitted
            when the queue is empty; otherwise it could never be served.
        max_bytes: bytes of bodies and answers in memory or in the spool folder. An answer is not
            refused once it is made, so those of the running requests may exceed it.
        max_requests: requests admitted and not yet finished.

    Attributes:
        draining: the service shuts down; new requests are refused.
        throughput: patches per second.
        patch_cost: seconds per patch.
        usage: total use of the queue.
        usage_by_owner: use of the queue by each owner.
        admitted: reservations in the order of their admission.
    """

    def __init__(self, max_patches: int, max_bytes: int, max_requests: int) -> None:
        self.max_patches = max_patches
        self.max_bytes = max_bytes
        self.max_requests = max_requests
        self.draining = False
        self.throughput = Throughput()
        self.patch_cost = PatchCost()
        self.usage = QueueUsage()
        self.usage_by_owner: defaultdict[str, QueueUsage] = defaultdict(QueueUsage)
        self.admitted: dict[Reservation, None] = {}

    @property
    def patches(self) -> int:
        """Patches admitted and not yet finished."""
        return self.usage.patches

    @property
    def bytes(self) -> int:
        """Bytes of bodies and of answers on their way out."""
        return self.usage.bytes

    @property
    def requests(self) -> int:
        """Requests admitted and not yet finished."""
        return self.usage.requests

    @property
    def has_room(self) -> bool:
        """Whether a small request would be admitted now."""
        return (
            not self.draining
            and self.usage.requests < self.max_requests
            and self.usage.patches < self.max_patches
            and self.usage.bytes < self.max_bytes
        )

    def reserve(self, owner: str = "") -> "Reservation":
        """Open the reservation of a new request.

        Args:
            owner: name of the API key; ``""`` without keys, where no shares apply.

        Raises:
            ProblemError: 503 while draining or if even the smallest request does not fit, 429 if
                the owner has its share of requests.
        """
        self.check_draining()
        if not self.has_room:
            raise self.queue_full(1)
        reservation = Reservation(self, owner)
        reservation.check_share(QueueUsage(requests=1))
        return reservation

    def check_draining(self) -> None:
        """Raise a `ProblemError`, 503, if the service shuts down."""
        if self.draining:
            raise draining()

    def queue_full(self, patches: int, unit: str | None = None) -> ProblemError:
        """Return the refusal of a request, with the time until it would fit.

        Args:
            patches: of the request.
            unit: exhausted unit (``"patches"``, ``"bytes"`` or ``"requests"``), if it is known.
        """
        now = self.usage
        excess = now.patches + patches - self.max_patches
        # If requests or bytes are exhausted and not patches, one request must end first.
        wait = self.throughput.seconds(excess if excess > 0 else now.patches / max(1, now.requests))
        setting = f"PUGEO_QUEUE_{(unit or self._exhausted(patches)).upper()}"
        detail = f"The queue is full, see {setting}; try again after the time in Retry-After."
        fields: dict[str, Any] = {
            "setting": setting,
            "queued_patches": now.patches,
            "capacity_patches": self.max_patches,
            "queued_requests": now.requests,
            "capacity_requests": self.max_requests,
        }
        return ProblemError(503, "queue_full", detail, retry_after=_bounded(wait), fields=fields)

    def _exhausted(self, patches: int) -> str:
        """Return the unit of which a further request of ``patches`` would take too much."""
        if self.usage.requests >= self.max_requests:
            return "requests"
        return "patches" if self.usage.patches + patches > self.max_patches else "bytes"

    def free(self) -> QueueUsage:
        """Return the unused part of the queue, each number >= 0."""
        return QueueUsage(
            max(0, self.max_patches - self.usage.patches),
            max(0, self.max_bytes - self.usage.bytes),
            max(0, self.max_requests - self.usage.requests),
        )


class Reservation:
    """Part of the queue that one request uses, returned at the end of the ``with`` block.

    Attributes:
        usage: patches, bytes and requests (0 or 1) of this request.
        large: it has at least `LARGE_PATCHES` patches.
    """

    def __init__(self, admission: Admission, owner: str) -> None:
        self._admission = admission
        self._owner = owner
        self._closed = False
        self.usage = QueueUsage()
        self.large = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed = True
        admission, was_admitted = self._admission, self.usage.requests
        self._add(QueueUsage(-self.usage.patches, -self.usage.bytes, -self.usage.requests))
        admission.admitted.pop(self, None)
        if admission.usage_by_owner.get(self._owner) == QueueUsage():
            del admission.usage_by_owner[self._owner]
        if was_admitted and admission.requests == 0:
            admission.throughput.stop()

    def add_bytes(self, size: int) -> None:
        """Reserve ``size`` further bytes of the body.

        Raises:
            ProblemError: 503 if all bodies together are too large, 429 if those of the owner are.
        """
        total = self._admission.usage
        others = total.bytes - self.usage.bytes
        if others and total.bytes + size > self._admission.max_bytes:
            raise self._admission.queue_full(1, "bytes")
        self.check_share(QueueUsage(bytes=size))
        self._add(QueueUsage(bytes=size))

    def admit(self, patches: int) -> None:
        """Enter the queue with an estimated number of patches, >= 1.

        Raises:
            ProblemError: 503 if the queue is full, 429 if the owner has its share.
        """
        admission, total = self._admission, self._admission.usage
        admission.check_draining()
        too_large = total.requests and total.patches + patches > admission.max_patches
        if too_large or total.requests >= admission.max_requests:
            raise admission.queue_full(patches)
        self.check_share(QueueUsage(patches=patches, requests=1))
        if total.requests == 0:
            admission.throughput.start()
        admission.admitted[self] = None
        self.large = patches >= LARGE_PATCHES
        self._add(QueueUsage(patches=patches, requests=1))

    def set_patches(self, patches: int) -> None:
        """Replace the estimate by the counted number of patches that remain."""
        # The engine's thread may send a count just before it learns of the end.
        if self._closed:
            return
        self._add(QueueUsage(patches=patches - self.usage.patches))
        self.large = patches >= LARGE_PATCHES

    def finish(self, patches: int) -> None:
        """Count ``patches`` as finished."""
        if not self._closed:
            self._add(QueueUsage(patches=-min(patches, self.usage.patches)))
        self._admission.throughput.add(patches)

    def hold_answer(self, size: int) -> None:
        """Leave the queue, and hold the ``size`` bytes of the answer until the end of the block.

        An answer on its way to a slow client takes room on the disk, and nothing else.
        """
        self._admission.admitted.pop(self, None)
        self._add(QueueUsage(-self.usage.patches, size - self.usage.bytes, -self.usage.requests))
        if self._admission.requests == 0:
            self._admission.throughput.stop()

    def check_share(self, more: QueueUsage) -> None:
        """Refuse an addition that would exceed the owner's share; see `fair_share`.

        Raises:
            ProblemError: 429.
        """
        if not self._owner:
            return
        free = self._admission.free()
        held = self._admission.usage_by_owner.get(self._owner, QueueUsage())
        for unit in ("patches", "bytes", "requests"):
            check_share(
                unit,
                "the queue",
                f"PUGEO_QUEUE_{unit.upper()}",
                held=getattr(held, unit),
                held_elsewhere=getattr(held, unit) - getattr(self.usage, unit),
                wanted=getattr(more, unit),
                free=getattr(free, unit),
                retry_after=functools.partial(self._until_returned, unit),
            )

    def check_deadline(
        self, remaining: float, workers: int, *, counted: bool, setting: str | None = None
    ) -> None:
        """Refuse a request at once if it cannot be finished in time.

        A small request waits for small requests that came earlier and have no more patches. A large
        one waits for large ones that came earlier; as many of them as there are workers run side
        by side, and all but one of these may end after this one.

        All times are lower bounds that count the network alone: refusing a request that would
        have been served is worse than a late 504.

        Args:
            remaining: seconds until the deadline.
            workers: number of workers.
            counted: the number of patches is counted; if it is an estimate, only the patches of
                other requests are used.
            setting: name of the setting that moves the deadline, if there is one.

        Raises:
            ProblemError: 503 because of the queue, 504 because of the size of the cloud itself.
        """
        patches = self.usage.patches
        earlier = itertools.takewhile(lambda other: other is not self, self._admission.admitted)
        same_class = sorted(other.usage.patches for other in earlier if other.large is self.large)
        if self.large:
            ahead = sum(same_class[: max(0, len(same_class) - workers + 1)])
        else:
            ahead = sum(other for other in same_class if other <= patches)
        cost = self._admission.patch_cost
        own_time = cost.lower_bound_s(patches, workers) if counted else 0.0
        queue_time = cost.lower_bound_s(ahead, workers)
        named: dict[str, Any] = {} if setting is None else {"setting": setting}
        remedy = (
            "Ask for a longer wait, or for no limit."
            if setting is None
            else f"The service allows more time with a larger {setting}."
        )
        if own_time > remaining:
            detail = (
                f"This cloud takes at least {own_time:.0f} s, and {remaining:.0f} s are left. "
                f"{remedy}"
            )
            fields = {"patches": patches, "seconds_left": round(remaining, 1), **named}
            raise ProblemError(504, "deadline_too_short", detail, retryable=False, fields=fields)
        if queue_time + own_time > remaining:
            detail = (
                f"Earlier requests take at least {queue_time:.0f} s, and {remaining:.0f} s are "
                f"left. Try again after the time in Retry-After. {remedy}"
            )
            fields = {"patches_ahead": ahead, "seconds_left": round(remaining, 1), **named}
            wait = _bounded(queue_time + own_time - remaining)
            raise ProblemError(503, "deadline_unmeetable", detail, retry_after=wait, fields=fields)

    def _add(self, more: QueueUsage) -> None:
        admission = self._admission
        for usage in (self.usage, admission.usage, admission.usage_by_owner[self._owner]):
            usage.patches += more.patches
            usage.bytes += more.bytes
            usage.requests += more.requests

    def _until_returned(self, unit: str, amount: float) -> float:
        """Estimate the seconds until the owner has returned ``amount`` units."""
        admission = self._admission
        own, total = admission.usage_by_owner[self._owner], admission.usage
        patches = amount if unit == "patches" else own.patches / max(1, own.requests)
        # The workers also work on the patches of other owners.
        wait = admission.throughput.seconds(patches * max(1, total.patches) / max(1, own.patches))
        return _bounded(wait)


def _bounded(seconds: float) -> float:
    return min(_MAX_RETRY_S, max(1.0, seconds))
