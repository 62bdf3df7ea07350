# SPDX-License-Identifier: Apache-2.0
"""How fast the service works: what every promise about time rests on."""

import time
from collections.abc import Callable

__all__ = ["DrainRate", "Pace"]

_HALF_LIFE_S = 20.0
# Nothing measured yet: a patch takes some tens of milliseconds on one processor.
_UNMEASURED = 20.0
_HALF_LIFE_PATCHES = 64.0


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

    def seconds(self, patches: float) -> float:
        """Return how long so many patches take, all workers on them; a guess at first."""
        return patches / (self.per_second or _UNMEASURED)


class Pace:
    """Seconds of the network on a patch, as a moving average that forgets by half in 64 patches.

    What the drain rate cannot tell: few small requests drain slowly because they do not fill the
    workers. The pace bounds from below how long anything can take.
    """

    def __init__(self) -> None:
        self._patches = 0.0
        self._seconds = 0.0

    def add(self, seconds: float, patches: int) -> None:
        """Count a batch that was run."""
        kept = 0.5 ** (patches / _HALF_LIFE_PATCHES)
        self._patches = self._patches * kept + patches
        self._seconds = self._seconds * kept + seconds

    def least_seconds(self, patches: int, workers: int) -> float:
        """Return the time that all workers together need at least; 0 before anything was run."""
        if not self._patches:
            return 0.0
        return patches * self._seconds / self._patches / max(1, workers)
