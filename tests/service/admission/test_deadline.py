# SPDX-License-Identifier: Apache-2.0
"""The client's time runs from its request's head, the service's own from the body's end."""

import asyncio

import pytest

from pugeo_service.admission.deadline import Deadline
from pugeo_service.http.cancellation import DeadlinePassedError
from pugeo_service.http.prefer import Preferences


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


async def receive(deadline: Deadline, clock: Clock, seconds: float) -> None:
    """Let the body arrive for some seconds."""
    async with deadline.arriving():
        clock.now += seconds


def test_the_services_limit_begins_with_the_work() -> None:
    """A slow line costs nothing of it."""
    clock = Clock()
    deadline = Deadline(Preferences(), 60, clock)
    asyncio.run(receive(deadline, clock, 1000))
    assert deadline.left == 60
    clock.now += 70
    assert deadline.left == 0
    assert (deadline.seconds, deadline.wait) == (60, None)
    assert "limit of this service" in deadline.shown


def test_the_clients_wait_begins_with_the_head() -> None:
    """It does not care what the time went to."""
    clock = Clock()
    deadline = Deadline(Preferences(wait=30), 60, clock)
    asyncio.run(receive(deadline, clock, 20))
    assert deadline.left == 10
    assert deadline.seconds == 30
    assert "Prefer" in deadline.shown


def test_the_service_never_waits_longer_than_it_would() -> None:
    """A client that offers a day gets the service's limit."""
    clock = Clock()
    deadline = Deadline(Preferences(wait=86400), 60, clock)
    asyncio.run(receive(deadline, clock, 1))
    assert (deadline.left, deadline.seconds) == (60, 60)


def test_respond_async_is_no_deadline() -> None:
    """There, wait says when to answer that the answer comes later."""
    deadline = Deadline(Preferences(respond_async=True, wait=1), 60, Clock())
    assert deadline.wait is None


def test_a_body_that_arrives_too_late() -> None:
    """Once the client stopped waiting, the rest of its body is not waited for."""

    async def scenario() -> None:
        deadline = Deadline(Preferences(wait=1), 60)
        async with deadline.arriving():
            await asyncio.sleep(30)

    with pytest.raises(DeadlinePassedError):
        asyncio.run(scenario())
