# SPDX-License-Identifier: Apache-2.0
"""Cancellation of work if its client disconnects, its deadline passes, or it cannot succeed."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import Request

from pugeo_service.admission.deadline import DeadlinePassedError
from pugeo_service.http.body import ClientDisconnectedError

__all__ = ["while_connected"]

T = TypeVar("T")


async def while_connected(
    request: Request,
    work: Coroutine[Any, Any, T],
    seconds: float,
    abort: "asyncio.Future[Any] | None" = None,
) -> T:
    """Run ``work``; cancel it if the client disconnects or the time is over.

    Args:
        request: a request whose body was read completely, so that the next event is a disconnect.
        work: coroutine to run.
        seconds: time limit.
        abort: receives an exception if the work cannot succeed.

    Raises:
        ClientDisconnectedError: the connection was closed.
        DeadlinePassedError: the time is over.
        Exception: raised by ``work``, or received by ``abort``.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_disconnected(request))
    ends: set[asyncio.Future[Any]] = {working, leaving}
    if abort is not None:
        ends.add(abort)
    try:
        await asyncio.wait(ends, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        if abort is not None and abort.done():
            abort.result()
        raise ClientDisconnectedError if leaving.done() else DeadlinePassedError
    finally:
        for task in ends:
            task.cancel()
        await asyncio.gather(*ends, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
