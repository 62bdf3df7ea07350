# SPDX-License-Identifier: Apache-2.0
"""Work that ends when its client leaves, its time is over, or there is no hope for it."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import Request

from pugeo_service.http.body import ClientDisconnectedError

__all__ = ["DeadlinePassedError", "while_connected"]

T = TypeVar("T")


class DeadlinePassedError(Exception):
    """The time of a request is over."""


async def while_connected(
    request: Request,
    work: Coroutine[Any, Any, T],
    seconds: float,
    hopeless: "asyncio.Future[Any] | None" = None,
) -> T:
    """Run ``work``, and cancel it when the client closes the connection or time is up.

    Args:
        request: a request whose body was read whole, so that the next event is its end.
        work: what to run.
        seconds: how long it may take.
        hopeless: gets an exception as soon as the work is known to be in vain.

    Raises:
        ClientDisconnectedError: the connection was closed.
        DeadlinePassedError: ``seconds`` are over.
        Exception: what ``work`` raised, or what ``hopeless`` got.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_disconnected(request))
    ends: set[asyncio.Future[Any]] = {working, leaving}
    if hopeless is not None:
        ends.add(hopeless)
    try:
        await asyncio.wait(ends, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        if hopeless is not None and hopeless.done():
            hopeless.result()
        raise ClientDisconnectedError if leaving.done() else DeadlinePassedError
    finally:
        for task in ends:
            task.cancel()
        await asyncio.gather(*ends, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
