# SPDX-License-Identifier: Apache-2.0
"""Workers that give no sign are found, and those that only compute are not."""

import os

from pugeo_service.engine.heartbeats import HeartbeatWatch, cpu_seconds


class Clock:
    """Time and processor time that tests set."""

    def __init__(self) -> None:
        self.now = 0.0
        self.used = 0.0

    def watch(self) -> HeartbeatWatch:
        """A watch with this clock."""
        return HeartbeatWatch(lambda: self.now)


def after(clock: Clock, watch: HeartbeatWatch, seconds: float, beat: float, busy: bool) -> bool:
    """Whether the worker hangs after some seconds with the same heartbeat."""
    hangs = False
    for _ in range(int(2 * seconds)):
        clock.now += 0.5
        clock.used += 0.4 if busy else 0.0
        hangs = bool(watch.hanging({"ours": beat}, {"ours": clock.used}))
    return hangs


def test_silence_without_work() -> None:
    """A worker that neither reports nor computes hangs after five seconds; a sign clears it."""
    clock = Clock()
    watch = clock.watch()
    assert watch.hanging({"ours": 1.0}, {"ours": 0.0}) == frozenset()
    assert not after(clock, watch, 4.5, 1.0, busy=False)
    assert after(clock, watch, 1.0, 1.0, busy=False)
    assert not after(clock, watch, 0.5, 2.0, busy=False)


def test_silence_with_work() -> None:
    """One that computes without a report, in code that holds the interpreter, has a minute."""
    clock = Clock()
    watch = clock.watch()
    watch.hanging({"ours": 1.0}, {"ours": 0.0})
    assert not after(clock, watch, 59.0, 1.0, busy=True)
    assert after(clock, watch, 2.0, 1.0, busy=True)


def test_silence_after_work() -> None:
    """One that is stopped amid work hangs five seconds after its work ended, not after a minute."""
    clock = Clock()
    watch = clock.watch()
    watch.hanging({"ours": 1.0}, {"ours": 0.0})
    assert not after(clock, watch, 20.0, 1.0, busy=True)
    assert not after(clock, watch, 4.5, 1.0, busy=False)
    assert after(clock, watch, 1.0, 1.0, busy=False)


def test_processor_time_that_is_known_later() -> None:
    """Processor time that is first known amid the silence is no sign of work; its growth is."""
    clock = Clock()
    watch = clock.watch()
    watch.hanging({"ours": 1.0}, {})
    for _ in range(6):
        clock.now += 0.5
        assert watch.hanging({"ours": 1.0}, {}) == frozenset()
    assert watch.silent(2.5) == {"ours"}
    assert not watch.silent(3.5)
    clock.used = 100.0
    assert not after(clock, watch, 2.0, 1.0, busy=False)
    assert after(clock, watch, 0.5, 1.0, busy=False)
    assert not after(clock, watch, 30.0, 1.0, busy=True)


def test_many_workers_report_seldom() -> None:
    """Of a thousand workers each reports every six seconds, which is no silence."""
    clock = Clock()
    watch = clock.watch()
    seen = {str(number): 1.0 for number in range(1000)}
    for _ in range(17):
        assert watch.hanging(seen, {}) == frozenset()
        clock.now += 1.0
    for _ in range(2):
        clock.now += 1.0
        hanging = watch.hanging(seen, {})
    assert hanging == seen.keys()


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
    watch.hanging({"ours": 1.0}, {"ours": 0.0})
    clock.now += 100.0
    assert watch.hanging({"ours": 1.0}, {"ours": 0.0}) == frozenset()
    assert after(clock, watch, 6.0, 1.0, busy=False)


def test_processor_time() -> None:
    """The processor time of a process grows; one that has ended has none."""
    before = cpu_seconds(os.getpid())
    assert before is not None
    sum(range(3_000_000))
    assert (cpu_seconds(os.getpid()) or 0.0) >= before
    assert cpu_seconds(2**22 + 1) is None
