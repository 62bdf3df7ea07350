# SPDX-License-Identifier: Apache-2.0
"""Workers that give no sign are found, and those that only compute are not."""

import os

from pugeo_service.engine.heartbeats import HeartbeatWatch, cpu_seconds

PIDS = {"ours": 7}


class Clock:
    """Time and processor time that tests set."""

    def __init__(self) -> None:
        self.now = 0.0
        self.used = 0.0

    def watch(self) -> HeartbeatWatch:
        """A watch with this clock."""
        return HeartbeatWatch(lambda _: self.used, lambda: self.now)


def after(clock: Clock, watch: HeartbeatWatch, seconds: float, beat: float, busy: bool) -> bool:
    """Whether the worker hangs after some seconds with the same heartbeat."""
    hangs = False
    for _ in range(int(2 * seconds)):
        clock.now += 0.5
        clock.used += 0.4 if busy else 0.0
        hangs = bool(watch.hanging({"ours": beat}, PIDS))
    return hangs


def test_silence_without_work() -> None:
    """A worker that neither reports nor computes hangs after five seconds; a sign clears it."""
    clock = Clock()
    watch = clock.watch()
    assert watch.hanging({"ours": 1.0}, PIDS) == frozenset()
    assert not after(clock, watch, 4.5, 1.0, busy=False)
    assert after(clock, watch, 1.0, 1.0, busy=False)
    assert not after(clock, watch, 0.5, 2.0, busy=False)


def test_silence_with_work() -> None:
    """One that computes without a report, in code that holds the interpreter, has a minute."""
    clock = Clock()
    watch = clock.watch()
    watch.hanging({"ours": 1.0}, PIDS)
    assert not after(clock, watch, 59.0, 1.0, busy=True)
    assert after(clock, watch, 2.0, 1.0, busy=True)


def test_workers_elsewhere() -> None:
    """Of a worker on another machine only the changes of its heartbeat count."""
    clock = Clock()
    watch = clock.watch()
    for beat in (5e9, 5e9 + 1, 5e9 + 1):
        clock.now += 1.0
        assert watch.hanging({"theirs": beat}, {}) == frozenset()
    for _ in range(5):
        clock.now += 1.0
        hanging = watch.hanging({"theirs": 5e9 + 1}, {})
    assert hanging == {"theirs"}


def test_a_pause_of_the_front() -> None:
    """After a pause of this process itself nobody is blamed."""
    clock = Clock()
    watch = clock.watch()
    watch.hanging({"ours": 1.0}, PIDS)
    clock.now += 100.0
    assert watch.hanging({"ours": 1.0}, PIDS) == frozenset()
    assert after(clock, watch, 6.0, 1.0, busy=False)


def test_processor_time() -> None:
    """The processor time of a process grows; one that has ended has none."""
    before = cpu_seconds(os.getpid())
    assert before is not None
    sum(range(3_000_000))
    assert (cpu_seconds(os.getpid()) or 0.0) >= before
    assert cpu_seconds(2**22 + 1) is None
