# SPDX-License-Identifier: Apache-2.0
"""Admission control: bounds of the queue, shares of owners, deadlines."""

import contextlib

import pytest

from pugeo_service.admission.admission import Admission, Reservation
from pugeo_service.admission.throughput import PatchCost, Throughput
from pugeo_service.problems import ProblemError


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_everything_is_given_back() -> None:
    """The end of the block returns patches, bytes and the request, even after an error."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=2)
    with contextlib.suppress(KeyError), admission.reserve() as reservation:
        reservation.add_bytes(60)
        reservation.admit(4)
        assert (admission.patches, admission.bytes, admission.requests) == (4, 60, 1)
        raise KeyError
    assert (admission.patches, admission.bytes, admission.requests) == (0, 0, 0)


def test_patches_are_bounded() -> None:
    """A request that does not fit is refused with Retry-After."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as first, admission.reserve() as second:
        first.admit(8)
        with pytest.raises(ProblemError) as caught:
            second.admit(3)
        assert (caught.value.status, caught.value.code) == (503, "queue_full")
        assert caught.value.retryable
        assert int(caught.value.headers["Retry-After"]) >= 1
        assert caught.value.fields["queued_patches"] == 8
        second.admit(2)
        assert admission.patches == 10


def test_one_larger_than_the_queue_is_served_alone() -> None:
    """A request larger than the queue is admitted while the queue is empty."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as large:
        large.admit(500)
        with pytest.raises(ProblemError, match="full"):
            admission.reserve()
    assert admission.has_room


def test_requests_are_bounded() -> None:
    """The number of requests is bounded, however few patches each has."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=1)
    with admission.reserve() as first, admission.reserve() as second:
        first.admit(1)
        with pytest.raises(ProblemError, match="full"):
            second.admit(1)


def test_bytes_are_bounded_while_they_arrive() -> None:
    """A body is refused as soon as all bodies together exceed the bound."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as first, admission.reserve() as second:
        first.add_bytes(90)
        second.add_bytes(10)
        with pytest.raises(ProblemError, match="full"):
            second.add_bytes(1)
        assert admission.bytes == 100


def test_the_estimate_is_corrected_and_worked_off() -> None:
    """The queue counts the estimate first, then the counted patches, then the remaining ones."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as reservation:
        reservation.admit(1)
        reservation.set_patches(7)
        assert admission.patches == 7
        reservation.finish(5)
        assert admission.patches == 2
        reservation.finish(5)
        assert admission.patches == 0


def test_draining_refuses() -> None:
    """While draining, new requests are refused and admitted ones stay."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as reservation:
        reservation.admit(1)
        admission.draining = True
        with pytest.raises(ProblemError) as caught:
            admission.reserve()
        assert (caught.value.status, caught.value.code) == (503, "draining")
        assert admission.requests == 1
    assert not admission.has_room


def test_draining_refuses_a_body_that_was_still_arriving() -> None:
    """A request counts as accepted once its body is here."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.reserve() as reservation:
        admission.draining = True
        with pytest.raises(ProblemError, match="shutting down"):
            reservation.admit(1)


def test_the_rate_is_measured_over_work_only() -> None:
    """Time with an empty queue does not count."""
    clock = Clock()
    throughput = Throughput(clock)
    assert throughput.per_second is None
    throughput.start()
    clock.now = 2.0
    throughput.add(10)
    throughput.stop()
    clock.now = 1000.0
    throughput.start()
    clock.now = 1001.0
    throughput.add(5)
    assert throughput.per_second == pytest.approx(5.0)


def test_the_rate_forgets() -> None:
    """After some half-lives only recent measurements count."""
    clock = Clock()
    throughput = Throughput(clock)
    throughput.start()
    for _ in range(10):
        clock.now += 1.0
        throughput.add(100)
    for _ in range(200):
        clock.now += 1.0
        throughput.add(1)
    assert throughput.per_second == pytest.approx(1.0, rel=0.1)


def test_retry_after_follows_the_rate() -> None:
    """Twice as slow means twice as long, and never more than two minutes."""
    waits = []
    for speed in (10, 5, 0.01):
        admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
        clock = Clock()
        admission.throughput = Throughput(clock)
        with admission.reserve() as first, admission.reserve() as second:
            first.admit(10)
            clock.now = 1.0
            admission.throughput.add(1)
            admission.throughput = Throughput(clock)
            admission.throughput.start()
            clock.now += 100 / speed
            admission.throughput.add(100)
            with pytest.raises(ProblemError) as caught:
                second.admit(100)
        waits.append(int(caught.value.headers["Retry-After"]))
    assert waits == [10, 20, 120]


def measured(admission: Admission, per_second: float) -> None:
    """Set the measured throughput of a queue."""
    clock = Clock()
    admission.throughput = Throughput(clock)
    admission.throughput.start()
    clock.now = 10.0
    admission.throughput.add(int(10 * per_second))


def refusal(reservation: Reservation, patches: int) -> ProblemError:
    """Return the problem with which a request is refused."""
    with pytest.raises(ProblemError) as caught:
        reservation.admit(patches)
    return caught.value


def test_one_owner_leaves_room_for_others() -> None:
    """One owner reaches half of the queue, then gets 429; another owner is still admitted."""
    admission = Admission(max_patches=100, max_bytes=1000, max_requests=99)
    measured(admission, per_second=10)
    with contextlib.ExitStack() as stack:
        for _ in range(5):
            stack.enter_context(admission.reserve("ann")).admit(10)
        problem = refusal(stack.enter_context(admission.reserve("ann")), 10)
        assert (problem.status, problem.code) == (429, "share_exceeded")
        assert problem.retryable
        assert problem.fields == {
            "unit": "patches",
            "held": 50,
            "wanted": 10,
            "free": 50,
            "setting": "PUGEO_QUEUE_PATCHES",
        }
        # Five patches fewer held are five more free: half a second at this speed, one at least.
        assert problem.headers["Retry-After"] == "1"
        stack.enter_context(admission.reserve("bob")).admit(40)
        assert admission.patches == 90
    assert admission.usage_by_owner == {}


def test_shares_shrink_with_their_number() -> None:
    """Two owners reach a third each, and the last third is free for the next owner."""
    admission = Admission(max_patches=90, max_bytes=1000, max_requests=999)
    with contextlib.ExitStack() as stack:
        refused = set()
        for turn in range(200):
            owner = ("ann", "bob")[turn % 2]
            try:
                stack.enter_context(admission.reserve(owner)).admit(1)
            except ProblemError as problem:
                refused.add((owner, problem.status))
        assert refused == {("ann", 429), ("bob", 429)}
        held = {owner: total.patches for owner, total in admission.usage_by_owner.items()}
        assert held == {"ann": 30, "bob": 30}
        stack.enter_context(admission.reserve("cleo")).admit(30)


def test_shares_hold_for_requests_and_bytes() -> None:
    """Shares hold for the number of requests and for bytes of bodies too."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=4)
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(admission.reserve("ann")).admit(1)
        with pytest.raises(ProblemError, match="requests") as caught:
            admission.reserve("ann")
        assert (caught.value.status, caught.value.fields["unit"]) == (429, "requests")
        first, second = admission.reserve("bob"), admission.reserve("bob")
        with first, second:
            first.add_bytes(40)
            second.add_bytes(10)
            with pytest.raises(ProblemError, match="bytes") as caught:
                second.add_bytes(1)
            assert (caught.value.status, caught.value.fields["unit"]) == (429, "bytes")


def test_one_large_request_may_exceed_a_share() -> None:
    """An owner with nothing else in the queue may exceed its share with one request."""
    admission = Admission(max_patches=100, max_bytes=100, max_requests=9)
    with admission.reserve("ann") as reservation:
        reservation.add_bytes(90)
        reservation.admit(90)
        assert refusal(admission.reserve("ann"), 8).status == 429
        assert refusal(admission.reserve("bob"), 11).status == 503
        admission.reserve("bob").admit(10)


def test_without_keys_there_are_no_shares() -> None:
    """Without owners the whole queue can be filled; the next request gets 503."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=99)
    with contextlib.ExitStack() as stack:
        for _ in range(10):
            stack.enter_context(admission.reserve()).admit(1)
        with pytest.raises(ProblemError) as caught:
            admission.reserve()
        assert caught.value.status == 503


def test_a_full_queue_of_requests_says_when_one_ends() -> None:
    """If requests are exhausted, Retry-After is the time of one request and not of one patch."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=2)
    measured(admission, per_second=10)
    with admission.reserve() as first, admission.reserve() as second, admission.reserve() as third:
        first.admit(100)
        second.admit(300)
        problem = refusal(third, 1)
        assert (problem.status, problem.headers["Retry-After"]) == (503, "20")


def with_cost(patches_per_second: float) -> Admission:
    """Return a queue with a measured cost of a patch."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=9)
    admission.patch_cost.add(10.0, int(10 * patches_per_second))
    return admission


def test_a_deadline_that_the_queue_cannot_meet() -> None:
    """503 with Retry-After at once; only requests that run earlier count."""
    admission = with_cost(5)
    reservations = [admission.reserve() for _ in range(6)]
    first, small, shorter, longer, second, large = reservations
    with first, small, shorter, longer, second, large:
        first.admit(1)
        longer.admit(300)
        shorter.admit(100)
        second.admit(5)
        large.admit(200)
        small.admit(2)
        # Small ones wait for small ones that came earlier and have no more patches.
        first.check_deadline(0.001, 2, counted=False)
        small.check_deadline(0.31, 2, counted=True)
        with pytest.raises(ProblemError) as caught:
            small.check_deadline(0.29, 2, counted=True)
        assert caught.value.fields == {"patches_ahead": 1, "seconds_left": 0.3}
        # An estimate of its own size is not counted; the longest earlier one may end later.
        large.check_deadline(11.0, 2, counted=False)
        with pytest.raises(ProblemError) as caught:
            large.check_deadline(9.0, 2, counted=False)
        assert (caught.value.status, caught.value.code) == (503, "deadline_unmeetable")
        assert caught.value.retryable
        assert caught.value.fields == {"patches_ahead": 100, "seconds_left": 9.0}
        assert caught.value.headers["Retry-After"] == "1"
        with pytest.raises(ProblemError) as caught:
            large.check_deadline(20.0, 2, counted=True)
        assert (caught.value.status, caught.value.headers["Retry-After"]) == (503, "10")
        large.check_deadline(20.0, 3, counted=True)


def test_a_deadline_that_the_cloud_itself_misses() -> None:
    """504 that is not retryable: the same request would take as long again."""
    admission = with_cost(5)
    with admission.reserve() as reservation:
        reservation.admit(400)
        reservation.check_deadline(41.0, 2, counted=True)
        with pytest.raises(ProblemError) as caught:
            reservation.check_deadline(39.0, 2, counted=True)
        assert (caught.value.status, caught.value.code) == (504, "deadline_too_short")
        assert not caught.value.retryable
        assert caught.value.fields == {"patches": 400, "seconds_left": 39.0}


def test_nothing_is_refused_on_a_guess() -> None:
    """No deadline is refused before the cost of a patch was measured."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=9)
    with admission.reserve() as reservation:
        reservation.admit(1000)
        reservation.check_deadline(0.001, 1, counted=True)


def test_the_pace_follows_the_present() -> None:
    """After some hundred patches only recent batches count, and the time is shared by workers."""
    cost = PatchCost()
    assert cost.lower_bound_s(5, 2) == 0.0
    cost.add(100.0, 10)
    assert cost.lower_bound_s(5, 2) == pytest.approx(25.0)
    for _ in range(1000):
        cost.add(0.1, 1)
    assert cost.lower_bound_s(5, 2) == pytest.approx(0.25, rel=0.01)


def test_news_after_the_end_changes_nothing() -> None:
    """A count that arrives after the end of a request is ignored."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=2)
    with admission.reserve("somebody") as reservation:
        reservation.admit(4)
    reservation.set_patches(7)
    reservation.finish(3)
    assert (admission.patches, dict(admission.usage_by_owner)) == (0, {})
