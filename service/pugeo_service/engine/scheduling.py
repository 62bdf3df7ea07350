# SPDX-License-Identifier: Apache-2.0
"""The order of requests: small ones about first come first served, large ones in turns beside them.

Shortest first would let large clouds wait as long as small ones keep coming; first come first
served would let small ones wait for large ones. Among small clouds the rule is therefore FIFO plus
3 s a patch; the penalty is finite, so nothing starves. Each kind has workers to count on: while
there are small clouds, large ones share all workers but one (one task at a time each), and small
ones have that one and all that large clouds leave. As many large clouds run as there are workers;
the others wait on disk and hold no memory.
"""

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import TracebackType

__all__ = ["LARGE_PATCHES", "FairSemaphore", "SchedulingPolicy"]

LARGE_PATCHES = 8
"""From this number of patches on, preparing a cloud and finishing it take seconds."""

_CLASS_S = 1e12  # seconds between the priorities of two classes; longer than any service lives
_PENALTY_S = 3.0  # seconds of later arrival that a patch counts as


class FairSemaphore:
    """A semaphore that is first come first served and whose size may change.

    Args:
        size: returns the number of holders allowed now; at least one is always allowed.

    Attributes:
        holders: number of holders now.
    """

    def __init__(self, size: Callable[[], int]) -> None:
        self._size = size
        self._waiting: deque[asyncio.Future[None]] = deque()
        self.holders = 0

    async def __aenter__(self) -> None:
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append(turn)
        self._admit()
        try:
            await turn
        except asyncio.CancelledError:
            # It may have been admitted at the moment when it was cancelled.
            if not turn.cancelled():
                self._release()
            raise

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._release()

    def _release(self) -> None:
        self.holders -= 1
        self._admit()

    def _admit(self) -> None:
        while self._waiting and self.holders < max(1, self._size()):
            turn = self._waiting.popleft()
            # A cancelled waiter is still in the queue.
            if not turn.done():
                self.holders += 1
                turn.set_result(None)


class SchedulingPolicy:
    """State that all requests of an engine share, and the priorities of their tasks.

    Args:
        workers: returns the number of warm workers.

    Attributes:
        large_requests: held by large requests that have begun.
        turns: held by each task of a large cloud that runs before all other tasks.
        requests: all requests under way.
        small: the small ones, for which large clouds leave one worker free.
        load: number of queued tasks that were placed on each worker.
    """

    FIRST = _CLASS_S
    """Priority of tasks that have a turn, or take no time."""

    def __init__(self, workers: Callable[[], int]) -> None:
        self.large_requests = FairSemaphore(workers)
        self.turns = FairSemaphore(lambda: workers() - bool(self.small))
        self.requests: set[object] = set()
        self.small: set[object] = set()
        self.load: Counter[str] = Counter()

    def register(self, request: object, patches: int, *, background: bool) -> None:
        """Note that a request is under way, and its size as far as it is known."""
        self.requests.add(request)
        if patches < LARGE_PATCHES and not background:
            self.small.add(request)
        else:
            self.small.discard(request)

    def unregister(self, request: object) -> None:
        """Note that a request is over."""
        self.requests.discard(request)
        self.small.discard(request)

    def least_loaded(self, workers: Sequence[str]) -> str | None:
        """Return the worker with the fewest placed tasks; ``None`` if there is no worker."""
        return min(workers, key=lambda worker: self.load[worker], default=None)

    @staticmethod
    def priority(arrived: float, patches: int, *, background: bool) -> float:
        """Return the priority of tasks without a turn; larger runs earlier.

        Args:
            arrived: time of the request, in seconds of any clock.
            patches: of its cloud.
            background: nobody waits on a connection.
        """
        large = patches >= LARGE_PATCHES
        return -_CLASS_S * (large + 2 * background) - (arrived + _PENALTY_S * patches)
