# SPDX-License-Identifier: Apache-2.0
"""Cancellation of work after a disconnect or a deadline."""

import asyncio

import pytest
from starlette.requests import Request
from starlette.types import Message

from pugeo_service.admission.deadline import DeadlinePassedError
from pugeo_service.http.body import ClientDisconnectedError
from pugeo_service.http.cancellation import while_connected


def make_request(*, leaves: bool = False) -> Request:
    """A request whose client leaves at once, or stays."""

    async def receive() -> Message:
        if not leaves:
            await asyncio.Event().wait()
        return {"type": "http.disconnect"}

    return Request({"type": "http"}, receive)


class Work:
    """Work that never ends by itself and records its cancellation."""

    def __init__(self) -> None:
        self.begun = asyncio.Event()
        self.cancelled = False

    async def __call__(self) -> None:
        self.begun.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            self.cancelled = True
            raise


async def succeed() -> str:
    """Work that ends at once."""
    return "done"


def test_the_result() -> None:
    """The result of the work is returned."""
    assert asyncio.run(while_connected(make_request(), succeed(), 60)) == "done"


def test_the_error() -> None:
    """An error of the work is raised."""

    async def fail() -> None:
        raise KeyError

    with pytest.raises(KeyError):
        asyncio.run(while_connected(make_request(), fail(), 60))


def test_the_client_leaves() -> None:
    """If the client disconnects, the work is cancelled before the call ends."""
    work = Work()
    with pytest.raises(ClientDisconnectedError):
        asyncio.run(while_connected(make_request(leaves=True), work(), 60))
    assert work.cancelled


def test_time_is_up() -> None:
    """If the time is over, the work is cancelled."""
    work = Work()
    with pytest.raises(DeadlinePassedError):
        asyncio.run(while_connected(make_request(), work(), 0.01))
    assert work.cancelled


def test_cancelling_from_outside() -> None:
    """Cancelling the call, as a shutdown does, cancels the work."""
    work = Work()

    async def scenario() -> None:
        task = asyncio.create_task(while_connected(make_request(), work(), 60))
        await work.begun.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(scenario())
    assert work.cancelled


def test_abort() -> None:
    """An exception in the future ``abort`` cancels the work and is raised."""
    work = Work()

    async def scenario() -> None:
        abort = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(while_connected(make_request(), work(), 60, abort))
        await work.begun.wait()
        abort.set_exception(KeyError("too late"))
        await task

    with pytest.raises(KeyError, match="too late"):
        asyncio.run(scenario())
    assert work.cancelled


def test_no_abort() -> None:
    """A future ``abort`` without a result has no effect."""

    async def scenario() -> str:
        abort = asyncio.get_running_loop().create_future()
        return await while_connected(make_request(), succeed(), 60, abort)

    assert asyncio.run(scenario()) == "done"
