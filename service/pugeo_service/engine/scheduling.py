# SPDX-License-Identifier: Apache-2.0
"""Who goes first: small clouds about in the order they came, large ones in turns beside them.

Shortest first would let large clouds wait as long as small ones keep coming; first come first
served would let small ones wait for large ones. So among small ones a patch more counts as seconds
of coming later, which nobody can lose to without end. And each kind has workers to count on:
while there are small clouds, large ones share all workers but one (each of their turns is one
task), small ones have that one and whatever large clouds leave. As many large clouds begin as
there are workers; the others wait on disk and hold no memory.
"""

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import TracebackType

__all__ = ["LARGE_PATCHES", "Lanes", "Line"]

LARGE_PATCHES = 8
"""From here on preparing a cloud and finishing it take seconds."""

_LANE = 1e12  # seconds that no service lives
_HANDICAP_S = 3.0


class Line:
    """A door that lets so many in at one time, first come first served.

    Args:
        places: how many may be inside now; at least one is let in.
    """

    def __init__(self, places: Callable[[], int]) -> None:
        self._places = places
        self._waiting: deque[asyncio.Future[None]] = deque()
        self.inside = 0

    async def __aenter__(self) -> None:
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append(turn)
        self._admit()
        try:
            await turn
        except asyncio.CancelledError:
            # It may have been let in just when it stopped waiting.
            if not turn.cancelled():
                self._leave()
            raise

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leave()

    def _leave(self) -> None:
        self.inside -= 1
        self._admit()

    def _admit(self) -> None:
        while self._waiting and self.inside < max(1, self._places()):
            turn = self._waiting.popleft()
            # Who stopped waiting is still in the line.
            if not turn.done():
                self.inside += 1
                turn.set_result(None)


class Lanes:
    """What all requests of an engine share.

    Args:
        workers: how many are warm now.

    Attributes:
        entrance: large requests that have begun.
        turns: tasks of large clouds that go before everything else.
        requests: that are under way.
        small: those of them to which large clouds leave a worker.
        load: parts of stages that each worker was given to do.
    """

    FIRST = _LANE
    """Priority of what has a turn, or is done in no time."""

    def __init__(self, workers: Callable[[], int]) -> None:
        self.entrance = Line(workers)
        self.turns = Line(lambda: workers() - bool(self.small))
        self.requests: set[object] = set()
        self.small: set[object] = set()
        self.load: Counter[str] = Counter()

    def stand(self, who: object, patches: int, *, background: bool) -> None:
        """Say that a request is under way, and how large it is as far as is known."""
        self.requests.add(who)
        if patches < LARGE_PATCHES and not background:
            self.small.add(who)
        else:
            self.small.discard(who)

    def leave(self, who: object) -> None:
        """Say that a request is over."""
        self.requests.discard(who)
        self.small.discard(who)

    def emptiest(self, places: Sequence[str]) -> str | None:
        """Return the worker with the fewest parts to do; ``None`` if there is none."""
        return min(places, key=lambda place: self.load[place], default=None)

    @staticmethod
    def priority(came: float, patches: int, *, background: bool) -> float:
        """Return the priority of tasks without a turn; larger runs earlier.

        Args:
            came: when the request came, in seconds of any clock.
            patches: of its cloud.
            background: nobody waits for it.
        """
        large = patches >= LARGE_PATCHES
        return -_LANE * (large + 2 * background) - (came + _HANDICAP_S * patches)
