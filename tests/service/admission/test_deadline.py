# SPDX-License-Identifier: Apache-2.0
"""Deadlines: the client's time starts with the head, the service's with the end of the body."""

import asyncio

import pytest

from pugeo_service.admission.deadline import Deadline, DeadlinePassedError


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


async def receive(deadline: Deadline, clock: Clock, seconds: float) -> None:
    """Let the body arrive for some seconds."""
    async with deadline.receiving_body():
        clock.now += seconds


def test_the_services_limit_begins_with_the_work() -> None:
    """A slow connection does not use up the limit of the service."""
    clock = Clock()
    deadline = Deadline(None, 60, clock)
    asyncio.run(receive(deadline, clock, 1000))
    assert deadline.remaining == 60
    clock.now += 70
    assert deadline.remaining == 0
    assert (deadline.seconds, deadline.wait) == (60, None)
    assert "limit of this service" in deadline.description
    assert deadline.setting == "PUGEO_DEADLINE_S"


def test_the_clients_wait_begins_with_the_head() -> None:
    """The time in which the body arrives counts too."""
    clock = Clock()
    deadline = Deadline(30, 60, clock)
    asyncio.run(receive(deadline, clock, 20))
    assert deadline.remaining == 10
    assert deadline.seconds == 30
    assert "Prefer" in deadline.description
    assert deadline.setting is None


def test_the_service_never_waits_longer_than_it_would() -> None:
    """A client that waits for a day gets the limit of the service."""
    clock = Clock()
    deadline = Deadline(86400, 60, clock)
    asyncio.run(receive(deadline, clock, 1))
    assert (deadline.remaining, deadline.seconds) == (60, 60)


def test_a_body_that_arrives_too_late() -> None:
    """The rest of the body is not awaited after the client's time."""

    async def scenario() -> None:
        deadline = Deadline(1, 60)
        async with deadline.receiving_body():
            await asyncio.sleep(30)

    with pytest.raises(DeadlinePassedError):
        asyncio.run(scenario())
