# SPDX-License-Identifier: Apache-2.0
"""Measured speed of the service, from which waiting times are estimated."""

import time
from collections.abc import Callable

__all__ = ["PatchCost", "Throughput"]

_HALF_LIFE_S = 20.0
# Before the first measurement: a patch takes about 50 ms on one processor.
_INITIAL_PATCHES_PER_S = 20.0
_HALF_LIFE_PATCHES = 64.0


class Throughput:
    """Patches finished per second, as an exponential moving average with a half-life of 20 s.

    Only time with work in the queue counts, so an idle service is not measured as slow.

    Args:
        clock: monotonic time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._patches = 0.0
        self._seconds = 0.0
        self._since: float | None = None

    def start(self) -> None:
        """Start the clock: the queue is no longer empty."""
        self._since = self._clock()

    def stop(self) -> None:
        """Stop the clock: the queue is empty."""
        self.add(0)
        self._since = None

    def add(self, patches: int) -> None:
        """Count patches that were just finished."""
        now = self._clock()
        elapsed = 0.0 if self._since is None else now - self._since
        self._since = now
        weight = 0.5 ** (elapsed / _HALF_LIFE_S)
        self._patches = self._patches * weight + patches
        self._seconds = self._seconds * weight + elapsed

    @property
    def per_second(self) -> float | None:
        """Patches per second; ``None`` before the first measurement."""
        return self._patches / self._seconds if self._patches and self._seconds else None

    def seconds(self, patches: float) -> float:
        """Estimate the seconds that all workers together need for a number of patches."""
        return patches / (self.per_second or _INITIAL_PATCHES_PER_S)


class PatchCost:
    """Seconds of the network per patch, as a moving average with a half-life of 64 patches.

    Throughput underestimates the speed while small requests leave workers idle. The cost of a
    patch gives a lower bound of the time instead.
    """

    def __init__(self) -> None:
        self._patches = 0.0
        self._seconds = 0.0

    def add(self, seconds: float, patches: int) -> None:
        """Count a batch of patches that took ``seconds``."""
        weight = 0.5 ** (patches / _HALF_LIFE_PATCHES)
        self._patches = self._patches * weight + patches
        self._seconds = self._seconds * weight + seconds

    def lower_bound_s(self, patches: int, workers: int) -> float:
        """Return the fewest seconds that ``workers`` need; 0 before the first measurement."""
        if not self._patches:
            return 0.0
        return patches * self._seconds / self._patches / max(1, workers)
