# SPDX-License-Identifier: Apache-2.0
"""Work ends with its client or its time, and its result or error is passed on."""

import asyncio

import pytest
from starlette.requests import Request
from starlette.types import Message

from pugeo_service.http.body import ClientDisconnectedError
from pugeo_service.http.cancellation import DeadlinePassedError, while_connected


def make_request(leaves_after: float) -> Request:
    """A request whose client leaves after some seconds."""

    async def receive() -> Message:
        await asyncio.sleep(leaves_after)
        return {"type": "http.disconnect"}

    return Request({"type": "http"}, receive)


class Work:
    """Work that notes how it ended."""

    def __init__(self) -> None:
        self.cancelled = False

    async def __call__(self, seconds: float) -> str:
        try:
            await asyncio.sleep(seconds)
        except asyncio.CancelledError:
            self.cancelled = True
            raise
        return "done"


def test_the_result() -> None:
    """Work that ends first is simply done."""
    assert asyncio.run(while_connected(make_request(9), Work()(0), 9)) == "done"


def test_the_error() -> None:
    """An error of the work is the caller's."""

    async def fail() -> None:
        raise KeyError

    with pytest.raises(KeyError):
        asyncio.run(while_connected(make_request(9), fail(), 9))


def test_the_client_leaves() -> None:
    """Work for nobody is cancelled, and has ended when the caller goes on."""
    work = Work()
    with pytest.raises(ClientDisconnectedError):
        asyncio.run(while_connected(make_request(0.01), work(9), 9))
    assert work.cancelled


def test_time_is_up() -> None:
    """So is work that takes too long."""
    work = Work()
    with pytest.raises(DeadlinePassedError):
        asyncio.run(while_connected(make_request(9), work(9), 0.01))
    assert work.cancelled


def test_cancelling_from_outside() -> None:
    """A shutdown that cancels the request cancels the work."""
    work = Work()

    async def scenario() -> None:
        task = asyncio.create_task(while_connected(make_request(9), work(9), 9))
        await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(scenario())
    assert work.cancelled


def test_no_hope() -> None:
    """Work that cannot end in time is cancelled as soon as that is known, with the reason."""
    work = Work()

    async def scenario() -> None:
        hopeless = asyncio.get_running_loop().create_future()
        asyncio.get_running_loop().call_later(0.01, hopeless.set_exception, KeyError("too late"))
        await while_connected(make_request(9), work(9), 9, hopeless)

    with pytest.raises(KeyError, match="too late"):
        asyncio.run(scenario())
    assert work.cancelled


def test_hope_that_was_never_lost() -> None:
    """A future that nothing comes of changes nothing."""

    async def scenario() -> str:
        hopeless = asyncio.get_running_loop().create_future()
        return await while_connected(make_request(9), Work()(0.01), 9, hopeless)

    assert asyncio.run(scenario()) == "done"
