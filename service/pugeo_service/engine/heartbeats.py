# SPDX-License-Identifier: Apache-2.0
"""Workers that give no sign: a process that hangs keeps its connections and looks warm."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import psutil

__all__ = ["HeartbeatWatch", "cpu_seconds"]

# A worker reports twice a second from a thread of its own. One that reports nothing and computes
# nothing for so long hangs.
_IDLE_S = 5.0
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
    seen: float
    since: float
    used: float | None


class HeartbeatWatch:
    """Finds workers that hang.

    Args:
        used: returns the processor time of a process, see `cpu_seconds`.
        clock: monotonic time in seconds.
    """

    def __init__(
        self,
        used: Callable[[int], float | None] = cpu_seconds,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._used = used
        self._clock = clock
        self._signs: dict[str, _Sign] = {}
        self._looked = clock()

    def hanging(self, seen: Mapping[str, float], pids: Mapping[str, int]) -> frozenset[str]:
        """Return the addresses of workers that hang; call it at least once a second.

        Args:
            seen: time of the last heartbeat of each worker. It is compared with earlier values
                only, since the clock may be that of another machine.
            pids: process ids of those workers that are on this machine.
        """
        now = self._clock()
        paused, self._looked = now - self._looked > _PAUSE_S, now
        signs, found = self._signs, []
        self._signs = {}
        for address, beat in seen.items():
            pid = pids.get(address)
            used = None if pid is None else self._used(pid)
            sign = signs.get(address)
            if sign is None or sign.seen != beat or paused:
                sign = _Sign(beat, now, used)
            self._signs[address] = sign
            busy = sign.used is not None and used is not None and used - sign.used > 0.0
            if now - sign.since > (_BUSY_S if busy else _IDLE_S):
                found.append(address)
        return frozenset(found)
