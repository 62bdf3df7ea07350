# SPDX-License-Identifier: Apache-2.0
"""The fair semaphore and the scheduling policy."""

import asyncio

import pytest

from pugeo_service.engine.scheduling import LARGE_PATCHES, FairSemaphore, SchedulingPolicy


async def run_until_idle() -> None:
    """Let all tasks run that can."""
    for _ in range(20):
        await asyncio.sleep(0)


def test_first_come_first_served() -> None:
    """As many holders as there are places, in the order of arrival."""
    order: list[int] = []
    most = 0

    async def main() -> None:
        semaphore = FairSemaphore(lambda: 2)

        async def one(number: int) -> None:
            nonlocal most
            async with semaphore:
                order.append(number)
                most = max(most, semaphore.holders)
                await asyncio.sleep(0)

        await asyncio.gather(*(one(number) for number in range(9)))
        assert semaphore.holders == 0

    asyncio.run(main())
    assert (order, most) == (list(range(9)), 2)


def test_places_come_and_go() -> None:
    """The number of places may change; at least one is always allowed."""

    async def main() -> None:
        places = 0
        semaphore = FairSemaphore(lambda: places)
        await semaphore.__aenter__()
        waiting = [asyncio.create_task(semaphore.__aenter__()) for _ in range(3)]
        await run_until_idle()
        assert semaphore.holders == 1
        places = 3
        latest = asyncio.create_task(semaphore.__aenter__())
        await run_until_idle()
        assert [task.done() for task in (*waiting, latest)] == [True, True, False, False]
        for task in (*waiting, latest):
            task.cancel()

    asyncio.run(main())


def test_a_cancelled_waiter_takes_no_place() -> None:
    """A waiter may be cancelled while waiting, or just after its admission."""

    async def main() -> None:
        semaphore = FairSemaphore(lambda: 1)
        await semaphore.__aenter__()
        gone, next_one = (asyncio.create_task(semaphore.__aenter__()) for _ in range(2))
        await asyncio.sleep(0)
        gone.cancel()
        await asyncio.sleep(0)
        await semaphore.__aexit__(None, None, None)
        next_one.cancel()
        with pytest.raises(asyncio.CancelledError):
            await next_one
        assert semaphore.holders == 0
        async with semaphore:
            assert semaphore.holders == 1

    asyncio.run(main())


def test_a_cancelled_waiter_is_skipped() -> None:
    """A waiter that is cancelled just before a place becomes free is skipped."""

    async def main() -> None:
        semaphore = FairSemaphore(lambda: 1)
        await semaphore.__aenter__()
        gone, stays = (asyncio.create_task(semaphore.__aenter__()) for _ in range(2))
        await asyncio.sleep(0)
        gone.cancel()
        await semaphore.__aexit__(None, None, None)
        await stays
        assert semaphore.holders == 1
        await semaphore.__aexit__(None, None, None)
        assert semaphore.holders == 0

    asyncio.run(main())


def test_priorities() -> None:
    """Requests precede jobs, small ones large ones, earlier ones later ones."""
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


def test_fewer_patches_overtake_for_a_time() -> None:
    """One patch overtakes five that arrived shortly before, but not much earlier ones."""
    five = SchedulingPolicy.priority(100.0, 5, background=False)
    assert SchedulingPolicy.priority(110.0, 1, background=False) > five
    assert SchedulingPolicy.priority(115.0, 1, background=False) < five


def test_small_clouds_have_a_worker() -> None:
    """While there is a small request, large ones leave it one worker; jobs do not count."""

    async def main() -> None:
        policy = SchedulingPolicy(lambda: 2)
        policy.register("job", 1, background=True)
        policy.register("cloud", 1, background=False)

        async def hold_two() -> None:
            async with policy.turns, policy.turns:
                pass

        waiting = asyncio.create_task(hold_two())
        await run_until_idle()
        assert not waiting.done()
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        # The cloud turns out to be large, or its request ends.
        for over in (
            lambda: policy.register("cloud", 8, background=False),
            lambda: policy.unregister("cloud"),
        ):
            policy.register("cloud", 1, background=False)
            over()
            await hold_two()

    asyncio.run(main())
