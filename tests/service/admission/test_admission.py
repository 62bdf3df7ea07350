# SPDX-License-Identifier: Apache-2.0
"""The queue is bounded in patches, bytes and requests, and gives everything back."""

import contextlib

import pytest

from pugeo_service.admission.admission import Admission, Hold
from pugeo_service.admission.throughput import DrainRate, Pace
from pugeo_service.problems import ProblemError


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
        with pytest.raises(ProblemError) as caught:
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
        with pytest.raises(ProblemError, match="full"):
            admission.hold()
    assert admission.has_room


def test_requests_are_bounded() -> None:
    """Many tiny requests fill the queue too."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=1)
    with admission.hold() as first, admission.hold() as second:
        first.enter(1)
        with pytest.raises(ProblemError, match="full"):
            second.enter(1)


def test_bytes_are_bounded_while_they_arrive() -> None:
    """A body that would take all requests over the bound is cut off."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as first, admission.hold() as second:
        first.grow(90)
        second.grow(10)
        with pytest.raises(ProblemError, match="full"):
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
        with pytest.raises(ProblemError) as caught:
            admission.hold()
        assert (caught.value.status, caught.value.code) == (503, "draining")
        assert admission.requests == 1
    assert not admission.has_room


def test_draining_refuses_a_body_that_was_still_arriving() -> None:
    """A request counts as accepted once its body is here."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=9)
    with admission.hold() as hold:
        admission.draining = True
        with pytest.raises(ProblemError, match="shutting down"):
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
            with pytest.raises(ProblemError) as caught:
                second.enter(100)
        waits.append(int(caught.value.headers["Retry-After"]))
    assert waits == [10, 20, 120]


def measured(admission: Admission, per_second: float) -> None:
    """Let the queue know its speed."""
    clock = Clock()
    admission.rate = DrainRate(clock)
    admission.rate.start()
    clock.now = 10.0
    admission.rate.add(int(10 * per_second))


def refusal(hold: Hold, patches: int) -> ProblemError:
    """The problem with which a request is refused."""
    with pytest.raises(ProblemError) as caught:
        hold.enter(patches)
    return caught.value


def test_one_owner_leaves_room_for_others() -> None:
    """Alone it comes to half of the queue, then gets 429; another one is let in beside it."""
    admission = Admission(max_patches=100, max_bytes=1000, max_requests=99)
    measured(admission, per_second=10)
    with contextlib.ExitStack() as stack:
        for _ in range(5):
            stack.enter_context(admission.hold("ann")).enter(10)
        problem = refusal(stack.enter_context(admission.hold("ann")), 10)
        assert (problem.status, problem.code) == (429, "share_exceeded")
        assert problem.retryable
        assert problem.fields == {"unit": "patches", "held": 50, "wanted": 10, "free": 50}
        # Five patches fewer held are five more free: half a second at this speed, one at least.
        assert problem.headers["Retry-After"] == "1"
        stack.enter_context(admission.hold("bob")).enter(40)
        assert admission.patches == 90
    assert admission.owners == {}


def test_shares_shrink_with_their_number() -> None:
    """Two greedy owners come to a third each, and the last third is free for whoever comes."""
    admission = Admission(max_patches=90, max_bytes=1000, max_requests=999)
    with contextlib.ExitStack() as stack:
        refused = set()
        for turn in range(200):
            owner = ("ann", "bob")[turn % 2]
            try:
                stack.enter_context(admission.hold(owner)).enter(1)
            except ProblemError as problem:
                refused.add((owner, problem.status))
        assert refused == {("ann", 429), ("bob", 429)}
        held = {owner: total.patches for owner, total in admission.owners.items()}
        assert held == {"ann": 30, "bob": 30}
        stack.enter_context(admission.hold("cleo")).enter(30)


def test_shares_hold_for_requests_and_bytes() -> None:
    """Many tiny requests, or few with large bodies, use a share up as well."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=4)
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(admission.hold("ann")).enter(1)
        with pytest.raises(ProblemError, match="requests") as caught:
            admission.hold("ann")
        assert (caught.value.status, caught.value.fields["unit"]) == (429, "requests")
        first, second = admission.hold("bob"), admission.hold("bob")
        with first, second:
            first.grow(40)
            second.grow(10)
            with pytest.raises(ProblemError, match="bytes") as caught:
                second.grow(1)
            assert (caught.value.status, caught.value.fields["unit"]) == (429, "bytes")


def test_one_large_request_may_exceed_a_share() -> None:
    """An owner with nothing else in the queue gets in whatever fits, else it never could."""
    admission = Admission(max_patches=100, max_bytes=100, max_requests=9)
    with admission.hold("ann") as hold:
        hold.grow(90)
        hold.enter(90)
        assert refusal(admission.hold("ann"), 8).status == 429
        assert refusal(admission.hold("bob"), 11).status == 503
        admission.hold("bob").enter(10)


def test_without_keys_there_are_no_shares() -> None:
    """Nobody's requests fill the whole queue; only then it is full, and that is 503."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=99)
    with contextlib.ExitStack() as stack:
        for _ in range(10):
            stack.enter_context(admission.hold()).enter(1)
        with pytest.raises(ProblemError) as caught:
            admission.hold()
        assert caught.value.status == 503


def test_a_full_queue_of_requests_says_when_one_ends() -> None:
    """Retry-After is then the time of one request, and not of one patch."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=2)
    measured(admission, per_second=10)
    with admission.hold() as first, admission.hold() as second, admission.hold() as third:
        first.enter(100)
        second.enter(300)
        problem = refusal(third, 1)
        assert (problem.status, problem.headers["Retry-After"]) == (503, "20")


def paced(patches_per_second: float) -> Admission:
    """A queue that knows how long the network takes."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=9)
    admission.pace.add(10.0, int(10 * patches_per_second))
    return admission


def test_a_deadline_that_the_queue_cannot_meet() -> None:
    """503 at once, with the time after which it could be; only what goes first counts."""
    admission = paced(5)
    holds = [admission.hold() for _ in range(6)]
    first, small, shorter, longer, second, large = holds
    with first, small, shorter, longer, second, large:
        first.enter(1)
        longer.enter(300)
        shorter.enter(100)
        second.enter(5)
        large.enter(200)
        small.enter(2)
        # Small ones wait for small ones that came first and have no more to do.
        first.check_deadline(0.001, 2, sized=False)
        small.check_deadline(0.31, 2, sized=True)
        with pytest.raises(ProblemError) as caught:
            small.check_deadline(0.29, 2, sized=True)
        assert caught.value.fields == {"patches_ahead": 1, "seconds_left": 0.3}
        # An estimate of its own size is no ground to refuse on; the longest may end later.
        large.check_deadline(11.0, 2, sized=False)
        with pytest.raises(ProblemError) as caught:
            large.check_deadline(9.0, 2, sized=False)
        assert (caught.value.status, caught.value.code) == (503, "deadline_unmeetable")
        assert caught.value.retryable
        assert caught.value.fields == {"patches_ahead": 100, "seconds_left": 9.0}
        assert caught.value.headers["Retry-After"] == "1"
        with pytest.raises(ProblemError) as caught:
            large.check_deadline(20.0, 2, sized=True)
        assert (caught.value.status, caught.value.headers["Retry-After"]) == (503, "10")
        large.check_deadline(20.0, 3, sized=True)


def test_a_deadline_that_the_cloud_itself_misses() -> None:
    """504, and no retry: the same request would take as long again."""
    admission = paced(5)
    with admission.hold() as hold:
        hold.enter(400)
        hold.check_deadline(41.0, 2, sized=True)
        with pytest.raises(ProblemError) as caught:
            hold.check_deadline(39.0, 2, sized=True)
        assert (caught.value.status, caught.value.code) == (504, "deadline_too_short")
        assert not caught.value.retryable
        assert caught.value.fields == {"patches": 400, "seconds_left": 39.0}


def test_nothing_is_refused_on_a_guess() -> None:
    """Before the network ran once, no deadline is called too short."""
    admission = Admission(max_patches=1000, max_bytes=100, max_requests=9)
    with admission.hold() as hold:
        hold.enter(1000)
        hold.check_deadline(0.001, 1, sized=True)


def test_the_pace_follows_the_present() -> None:
    """After some hundred patches only the present counts, and workers share the work."""
    pace = Pace()
    assert pace.least_seconds(5, 2) == 0.0
    pace.add(100.0, 10)
    assert pace.least_seconds(5, 2) == pytest.approx(25.0)
    for _ in range(1000):
        pace.add(0.1, 1)
    assert pace.least_seconds(5, 2) == pytest.approx(0.25, rel=0.01)


def test_news_after_the_end_changes_nothing() -> None:
    """A count that another thread sends as the request ends would stay for good."""
    admission = Admission(max_patches=10, max_bytes=100, max_requests=2)
    with admission.hold("somebody") as hold:
        hold.enter(4)
    hold.resize(7)
    hold.finish(3)
    assert (admission.patches, dict(admission.owners)) == (0, {})
