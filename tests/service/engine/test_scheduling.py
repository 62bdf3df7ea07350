# SPDX-License-Identifier: Apache-2.0
"""Lines are first come first served, and nobody is lost in them."""

import asyncio

import pytest

from pugeo_service.engine.scheduling import LARGE_PATCHES, FairSemaphore, SchedulingPolicy


def test_first_come_first_served() -> None:
    """As many inside as there are places, in the order they came."""
    order: list[int] = []
    most = 0

    async def main() -> None:
        line = FairSemaphore(lambda: 2)

        async def one(number: int) -> None:
            nonlocal most
            async with line:
                order.append(number)
                most = max(most, line.holders)
                await asyncio.sleep(0.001)

        await asyncio.gather(*(one(number) for number in range(9)))
        assert line.holders == 0

    asyncio.run(main())
    assert (order, most) == (list(range(9)), 2)


def test_places_come_and_go() -> None:
    """More places are used by whoever comes next; with none, one is let in all the same."""

    async def main() -> None:
        places = 0
        line = FairSemaphore(lambda: places)
        await line.__aenter__()
        waiting = [asyncio.create_task(line.__aenter__()) for _ in range(3)]
        await asyncio.sleep(0)
        assert line.holders == 1
        places = 3
        latest = asyncio.create_task(line.__aenter__())
        await asyncio.sleep(0.01)
        assert [task.done() for task in (*waiting, latest)] == [True, True, False, False]
        for task in (*waiting, latest):
            task.cancel()

    asyncio.run(main())


def test_who_leaves_the_line_takes_no_place() -> None:
    """Cancelled while waiting, or at the moment of being let in."""

    async def main() -> None:
        line = FairSemaphore(lambda: 1)
        await line.__aenter__()
        gone, next_one = (asyncio.create_task(line.__aenter__()) for _ in range(2))
        await asyncio.sleep(0)
        gone.cancel()
        await asyncio.sleep(0)
        await line.__aexit__(None, None, None)
        next_one.cancel()
        with pytest.raises(asyncio.CancelledError):
            await next_one
        assert line.holders == 0
        async with line:
            assert line.holders == 1

    asyncio.run(main())


def test_who_stopped_waiting_is_passed_over() -> None:
    """Also where the place becomes free before anybody has heard of it."""

    async def main() -> None:
        line = FairSemaphore(lambda: 1)
        await line.__aenter__()
        gone, stays = (asyncio.create_task(line.__aenter__()) for _ in range(2))
        await asyncio.sleep(0)
        gone.cancel()
        await line.__aexit__(None, None, None)
        await stays
        assert line.holders == 1
        await line.__aexit__(None, None, None)
        assert line.holders == 0

    asyncio.run(main())


def test_ranks() -> None:
    """Requests before jobs, small before large, and then who came first."""
    small, large = 1, LARGE_PATCHES
    ranks = [
        SchedulingPolicy.FIRST,
        SchedulingPolicy.priority(1.0, small, background=False),
        SchedulingPolicy.priority(1.1, small, background=False),
        SchedulingPolicy.priority(1.0, large, background=False),
        SchedulingPolicy.priority(1.0, small, background=True),
        SchedulingPolicy.priority(1.0, large, background=True),
    ]
    assert ranks == sorted(ranks, reverse=True)
    assert len(set(ranks)) == len(ranks)


def test_who_has_less_to_do_overtakes_for_a_while() -> None:
    """One patch goes before five that came a little earlier, but not before all that did."""
    five = SchedulingPolicy.priority(100.0, 5, background=False)
    assert SchedulingPolicy.priority(110.0, 1, background=False) > five
    assert SchedulingPolicy.priority(115.0, 1, background=False) < five


def test_a_worker_is_left_to_small_clouds_where_there_are_any() -> None:
    """Large ones have all of them otherwise; jobs, which nobody waits for, do not count."""

    async def main() -> None:
        lanes = SchedulingPolicy(lambda: 2)
        lanes.register("job", 1, background=True)
        lanes.register("cloud", 1, background=False)

        async def inside() -> int:
            async with asyncio.timeout(0.05), lanes.turns, lanes.turns:
                return 2
            return 1

        with pytest.raises(TimeoutError):
            await inside()
        # It turned out to be large, or is done.
        for over in (
            lambda: lanes.register("cloud", 8, background=False),
            lambda: lanes.unregister("cloud"),
        ):
            lanes.register("cloud", 1, background=False)
            over()
            assert await inside() == 2

    asyncio.run(main())
