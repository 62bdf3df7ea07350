# SPDX-License-Identifier: Apache-2.0
"""The queue is bounded in patches, bytes and requests, and gives everything back."""

import contextlib

import pytest

from pugeo_service.admission import Admission, DrainRate
from pugeo_service.problems import Problem


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_everything_is_given_back() -> None:
    """Leaving the block frees patches, bytes and the request, even after an error."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=2)
    with contextlib.suppress(KeyError), admission.hold() as hold:
        hold.grow(60)
        hold.enter(4)
        assert (admission.patches, admission.bytes, admission.requests) == (4, 60, 1)
        raise KeyError
    assert (admission.patches, admission.bytes, admission.requests) == (0, 0, 0)


def test_patches_are_bounded() -> None:
    """What does not fit beside the others is refused with a time to come back."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as first, admission.hold() as second:
        first.enter(8)
        with pytest.raises(Problem) as caught:
            second.enter(3)
        assert (caught.value.status, caught.value.code) == (503, "queue_full")
        assert caught.value.retryable
        assert int(caught.value.headers["Retry-After"]) >= 1
        assert caught.value.fields["queued_patches"] == 8
        second.enter(2)
        assert admission.patches == 10


def test_one_larger_than_the_queue_is_served_alone() -> None:
    """Else it could never be served at all."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as large:
        large.enter(500)
        with pytest.raises(Problem, match="full"):
            admission.hold()
    assert admission.has_room


def test_requests_are_bounded() -> None:
    """Many tiny requests fill the queue too."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=1)
    with admission.hold() as first, admission.hold() as second:
        first.enter(1)
        with pytest.raises(Problem, match="full"):
            second.enter(1)


def test_bytes_are_bounded_while_they_arrive() -> None:
    """A body that would take all requests over the bound is cut off."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as first, admission.hold() as second:
        first.grow(90)
        second.grow(10)
        with pytest.raises(Problem, match="full"):
            second.grow(1)
        assert admission.bytes == 100


def test_the_estimate_is_corrected_and_worked_off() -> None:
    """The gauge follows what is known: estimate, then count, then what remains."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as hold:
        hold.enter(1)
        hold.resize(7)
        assert admission.patches == 7
        hold.finish(5)
        assert admission.patches == 2
        hold.finish(5)
        assert admission.patches == 0


def test_draining_refuses() -> None:
    """On shutdown nobody is let in, and whoever was stays."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as hold:
        hold.enter(1)
        admission.draining = True
        with pytest.raises(Problem) as caught:
            admission.hold()
        assert (caught.value.status, caught.value.code) == (503, "draining")
        assert admission.requests == 1
    assert not admission.has_room


def test_draining_refuses_a_body_that_was_still_arriving() -> None:
    """A request counts as accepted once its body is here."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as hold:
        admission.draining = True
        with pytest.raises(Problem, match="shutting down"):
            hold.enter(1)


def test_the_rate_is_measured_over_work_only() -> None:
    """Idle time does not make the service look slow."""
    clock = Clock()
    rate = DrainRate(clock)
    assert rate.per_second is None
    rate.start()
    clock.now = 2.0
    rate.add(10)
    rate.stop()
    clock.now = 1000.0
    rate.start()
    clock.now = 1001.0
    rate.add(5)
    assert rate.per_second == pytest.approx(5.0)


def test_the_rate_forgets() -> None:
    """After some half-lives only the present speed counts."""
    clock = Clock()
    rate = DrainRate(clock)
    rate.start()
    for _ in range(10):
        clock.now += 1.0
        rate.add(100)
    for _ in range(200):
        clock.now += 1.0
        rate.add(1)
    assert rate.per_second == pytest.approx(1.0, rel=0.1)


def test_retry_after_follows_the_rate() -> None:
    """Twice as slow means twice as long, and never more than two minutes."""
    waits = []
    for speed in (10, 5, 0.01):
        admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
        clock = Clock()
        admission.rate = DrainRate(clock)
        with admission.hold() as first, admission.hold() as second:
            first.enter(10)
            clock.now = 1.0
            admission.rate.add(1)
            admission.rate = DrainRate(clock)
            admission.rate.start()
            clock.now += 100 / speed
            admission.rate.add(100)
            with pytest.raises(Problem) as caught:
                second.enter(100)
        waits.append(int(caught.value.headers["Retry-After"]))
    assert waits == [10, 20, 120]
