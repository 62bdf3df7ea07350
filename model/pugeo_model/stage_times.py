# SPDX-License-Identifier: Apache-2.0
"""Seconds of wall time spent in each stage."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

__all__ = ["StageTimes"]


class StageTimes:
    """Sums of seconds by stage name, in the order in which the stages first began.

    Args:
        on_begin: called with the name of a stage each time its measurement begins.

    Attributes:
        seconds: stage name -> seconds.
    """

    def __init__(self, on_begin: Callable[[str], object] | None = None) -> None:
        self._on_begin = on_begin
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the wall time of the ``with`` block to a stage."""
        if self._on_begin is not None:
            self._on_begin(stage)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add seconds that were measured elsewhere."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
