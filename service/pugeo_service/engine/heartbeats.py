# SPDX-License-Identifier: Apache-2.0
"""Workers that give no sign: a process that hangs keeps its connections and looks warm."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import psutil
from distributed.scheduler import heartbeat_interval

__all__ = ["HeartbeatWatch", "cpu_seconds"]

# A worker reports twice a second from a thread of its own. One that reports nothing and computes
# nothing for so long hangs.
_IDLE_S = 5.0
# The more workers there are, the more seldom Dask lets each of them report.
_IDLE_BEATS = 3.0
# A stage in C code may hold the interpreter for some seconds, and so long at most.
_BUSY_S = 60.0
# After a pause of this process itself, nothing is known about the workers.
_PAUSE_S = 2.0


def cpu_seconds(pid: int) -> float | None:
    """Return the seconds of processor time that a process has used; ``None`` if it has ended."""
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.Error:
        return None
    return float(times.user + times.system)


@dataclass
class _Sign:
    """The last signs of a worker: a heartbeat, and processor time that grew."""

    seen: float
    since: float
    used: float | None
    worked: float

    def note(self, used: float | None, now: float) -> None:
        """Note the processor time, where it is known."""
        if used is None:
            return
        if self.used is not None and used > self.used:
            self.worked = now
        self.used = used


class HeartbeatWatch:
    """Finds workers that hang.

    Args:
        clock: monotonic time in seconds.
        idle_s: seconds without a report and without work after which a worker hangs.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, idle_s: float = _IDLE_S
    ) -> None:
        self._clock = clock
        self._idle_s = idle_s
        self._signs: dict[str, _Sign] = {}
        self._looked = clock()

    def hanging(
        self, seen: Mapping[str, float], used: Mapping[str, float | None]
    ) -> frozenset[str]:
        """Return the addresses of workers that hang; call it at least once a second.

        Args:
            seen: time of the last heartbeat of each worker. It is compared with earlier values
                only, since the clock may be that of another machine.
            used: processor time of those workers of which it is known, see `cpu_seconds`.
        """
        now = self._clock()
        paused, self._looked = now - self._looked > _PAUSE_S, now
        idle_s = max(self._idle_s, _IDLE_BEATS * heartbeat_interval(len(seen)))
        signs, found = self._signs, []
        self._signs = {}
        for address, beat in seen.items():
            sign = signs.get(address)
            if sign is None or sign.seen != beat or paused:
                sign = _Sign(beat, now, used.get(address), now)
            sign.note(used.get(address), now)
            self._signs[address] = sign
            # Not the work since the last report: a worker that is stopped may have worked before.
            if now - sign.worked > idle_s or now - sign.since > max(_BUSY_S, idle_s):
                found.append(address)
        return frozenset(found)

    def silent(self, seconds: float) -> frozenset[str]:
        """Return the workers that had reported nothing for so long when they were looked at."""
        return frozenset(
            address for address, sign in self._signs.items() if self._looked - sign.since > seconds
        )
