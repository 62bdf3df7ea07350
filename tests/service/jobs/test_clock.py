# SPDX-License-Identifier: Apache-2.0
"""Clocks that jump: results of jobs are kept."""

import asyncio
import time
from typing import Any

import pytest

from pugeo_service.jobs.clock import SteadyClock


def start_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the clock of the process, which would remember the jumps of a test."""
    steady = SteadyClock()
    monkeypatch.setattr("pugeo_service.jobs.clock.now", steady.now)
    monkeypatch.setattr("pugeo_service.jobs.clock.deletion_time", steady.deletion_time)


def count_passes(house: Any) -> list[None]:
    """Return a list that grows by one with each look for expired results."""
    passes: list[None] = []
    expire = house.jobs._maintenance._expire

    async def counted() -> None:
        await expire()
        passes.append(None)

    house.jobs._maintenance._expire = counted
    return passes


def test_a_clock_that_jumps_deletes_nothing(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the clock is two days ahead, or behind, results are kept and new ones last."""
    real = time.time
    ahead = [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + ahead[0])
    start_clock(monkeypatch)

    async def scenario(house: Any) -> None:
        first = await house.submit()
        await house.until(first["id"], "succeeded")
        passes = count_passes(house)
        for jump in (2 * 86_400.0, -2 * 86_400.0, 0.0):
            ahead[0] = jump
            passes.clear()
            await house.eventually(lambda: len(passes) >= 3)
            job = await house.submit()
            await house.until(job["id"], "succeeded")
        for job in (await house.http.get("/jobs")).json()["jobs"]:
            assert job["state"] == "succeeded"
            assert (await house.http.get(f"/jobs/{job['id']}/result")).status_code == 200

    play(scenario)


def test_a_start_with_a_wrong_clock_deletes_nothing(
    open_house: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service that starts with its clock two days ahead keeps results; later they expire."""
    real = time.time
    ahead = [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + ahead[0])

    async def run() -> None:
        start_clock(monkeypatch)
        async with open_house() as house:
            job = await house.submit()
            await house.until(job["id"], "succeeded")
        ahead[0] = 2 * 86_400.0
        start_clock(monkeypatch)
        monkeypatch.setattr("pugeo_service.jobs.clock._SETTLE_S", 1e9)
        async with open_house() as house:
            passes = count_passes(house)
            await house.eventually(lambda: len(passes) >= 3)
            ahead[0] = 0.0
            await house.eventually(lambda: len(passes) >= 6)
            result = await house.http.get(f"/jobs/{job['id']}/result")
            assert result.status_code == 200
        ahead[0] = 2 * 86_400.0
        start_clock(monkeypatch)
        monkeypatch.setattr("pugeo_service.jobs.clock._SETTLE_S", 0.0)
        async with open_house() as house:
            await house.until(job["id"], "expired")

    asyncio.run(run())


def test_a_jump_that_lasts_is_a_correction(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small steps count at once, a jump after an hour; one that ends before never does."""
    wall, monotonic = [1e9], [0.0]
    monkeypatch.setattr(time, "time", lambda: wall[0])
    monkeypatch.setattr(time, "monotonic", lambda: monotonic[0])
    steady = SteadyClock()
    monkeypatch.setattr("pugeo_service.jobs.clock._SETTLE_S", 0.0)

    def after(seconds: float, jump: float = 0.0) -> float:
        monotonic[0] += seconds
        wall[0] += seconds + jump
        return steady.now() - 1e9

    assert after(1.0) == 1.0
    assert after(1.0, 30.0) == 32.0
    assert after(1.0, 86_400.0) == 33.0
    assert after(3000.0) == 3033.0
    assert after(1.0, -86_400.0) == 3034.0
    assert after(1.0, 86_400.0) == 3035.0
    assert after(3500.0) == 6535.0
    assert after(100.0) == 6635.0 + 86_400.0


@pytest.mark.parametrize("jump", [2 * 86_400.0, 0.0, -2 * 86_400.0])
def test_a_clock_that_is_wrong_at_the_start(monkeypatch: pytest.MonkeyPatch, jump: float) -> None:
    """Nothing is deleted before the clock was steady for ten minutes; then what is over is."""
    wall, monotonic = [1e9 + jump], [50.0]
    monkeypatch.setattr(time, "time", lambda: wall[0])
    monkeypatch.setattr(time, "monotonic", lambda: monotonic[0])
    steady = SteadyClock()

    def after(seconds: float, correction: float = 0.0) -> float:
        monotonic[0] += seconds
        wall[0] += seconds + correction
        return steady.deletion_time()

    assert (steady.now(), steady.deletion_time()) == (wall[0], 0.0)
    assert after(500.0) == 0.0
    assert after(1.0, -jump) == 0.0
    if jump < 0.0:
        # Trusted after an hour, as every jump ahead.
        assert steady.now() == wall[0] + jump
        assert after(3600.0) == 0.0
    assert steady.now() == wall[0]
    assert after(98.0) == 0.0
    if jump:
        assert after(501.0) == 0.0
    assert after(2.0) == wall[0]
    # From then on a jump neither counts nor stops deletions.
    assert after(5.0, 2 * 86_400.0) == wall[0] - 2 * 86_400.0
