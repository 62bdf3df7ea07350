# SPDX-License-Identifier: Apache-2.0
"""Looking at the processes of a service from outside."""

import importlib
import statistics
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

__all__ = ["Sample", "Watch", "family", "psutil"]

# Comes with Dask, without types.
psutil: Any = importlib.import_module("psutil")


@dataclass(frozen=True)
class Sample:
    """One look.

    Attributes:
        at: seconds on the monotonic clock.
        rss: resident bytes of all processes together.
        front_rss: of the one that answers.
        front_files: its open file descriptors.
    """

    at: float
    rss: int
    front_rss: int
    front_files: int


def family(pid: int) -> list[Any]:
    """A process and everything it started, as far as it lives."""
    try:
        front = psutil.Process(pid)
        return [front, *front.children(recursive=True)]
    except psutil.Error:
        return []


class Watch:
    """Looks at a service every ``seconds`` while the block runs.

    Args:
        pid: of its front.
        seconds: between two looks.
    """

    def __init__(self, pid: int, seconds: float = 1.0) -> None:
        self.samples: list[Sample] = []
        self._pid = pid
        self._seconds = seconds
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def look(self) -> Sample | None:
        """Look once; ``None`` where the front is gone."""
        sizes = []
        files = 0
        for process in family(self._pid):
            try:
                sizes.append(process.memory_info().rss)
                files = files or process.num_fds()
            except psutil.Error:
                continue
        return Sample(time.monotonic(), sum(sizes), sizes[0], files) if sizes else None

    def growth(self, share: float, *, front: bool = False) -> float:
        """Median of the last ``share`` of the time over that of the first, less 1."""
        began, ended = self.samples[0].at, self.samples[-1].at
        part = share * (ended - began)
        size = {one.at: one.front_rss if front else one.rss for one in self.samples}
        first = statistics.median(rss for at, rss in size.items() if at <= began + part)
        last = statistics.median(rss for at, rss in size.items() if at >= ended - part)
        return last / first - 1.0

    def _run(self) -> None:
        while True:
            sample = self.look()
            if sample is not None:
                self.samples.append(sample)
            if self._over.wait(self._seconds):
                return
