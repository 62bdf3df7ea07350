# SPDX-License-Identifier: Apache-2.0
"""Life signs of processes in the database."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from pugeo_service.jobs.database import Database
from pugeo_service.jobs.runner_beats import RunnerBeats

Scenario = Callable[[RunnerBeats, RunnerBeats], Awaitable[None]]


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        """Return its time."""
        return self.now


clock = Clock()


@pytest.fixture
def play(tmp_path: Path, database_url: str | None) -> Callable[[Scenario], None]:
    """Run a scenario with the signs of two processes."""

    async def run(scenario: Scenario) -> None:
        database = Database(database_url or f"sqlite:///{tmp_path}/jobs.sqlite3")
        try:
            await scenario(RunnerBeats(database, "one", clock), RunnerBeats(database, "two", clock))
        finally:
            database.close()

    return lambda scenario: asyncio.run(run(scenario))


async def watched(watcher: RunnerBeats, seconds: int) -> list[str]:
    """Return the others that a process calls ended after some seconds of a look each second."""
    for _ in range(seconds):
        clock.now += 1.0
        found = await watcher.ended(["one", "two"])
    return found


def test_a_process_that_beats_lives(play: Callable[[Scenario], None]) -> None:
    """However long it lasts, one that counts up has not ended."""

    async def scenario(one: RunnerBeats, two: RunnerBeats) -> None:
        for _ in range(10):
            await two.beat()
            assert await watched(one, 10) == []

    play(scenario)


def test_a_silent_process_has_ended(play: Callable[[Scenario], None]) -> None:
    """After 15 s without a sign, and not before; with a row, and without one."""

    async def scenario(one: RunnerBeats, two: RunnerBeats) -> None:
        await two.beat()
        assert await watched(one, 15) == []
        assert await watched(one, 2) == ["two"]
        await two.beat()
        assert await watched(one, 10) == []
        await two.stop()
        assert await watched(one, 10) == []
        assert await watched(one, 7) == ["two"]

    play(scenario)


def test_a_pause_of_the_watcher_proves_nothing(play: Callable[[Scenario], None]) -> None:
    """After a time in which it did not look, it waits again."""

    async def scenario(one: RunnerBeats, two: RunnerBeats) -> None:
        await two.beat()
        await watched(one, 10)
        clock.now += 600.0
        assert await watched(one, 10) == []
        assert await watched(one, 7) == ["two"]

    play(scenario)


def test_rows_of_the_dead_are_deleted(play: Callable[[Scenario], None]) -> None:
    """After an hour; a process that comes back has a row again."""

    async def scenario(one: RunnerBeats, two: RunnerBeats) -> None:
        await two.beat()
        for _ in range(1000):
            clock.now += 5.0
            found = await one.ended(["two"])
        assert found == ["two"]
        await two.beat()
        assert await one.ended(["two"]) == []

    play(scenario)
