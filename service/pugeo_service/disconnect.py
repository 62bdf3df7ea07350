# SPDX-License-Identifier: Apache-2.0
"""Work that ends when its client leaves or its time is over."""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import Request

from pugeo_service.body import ClientGone

__all__ = ["DeadlinePassed", "while_connected"]

T = TypeVar("T")


class DeadlinePassed(Exception):
    """The time of a request is over."""


async def while_connected(request: Request, work: Coroutine[Any, Any, T], seconds: float) -> T:
    """Run ``work``, and cancel it when the client closes the connection or time is up.

    Args:
        request: a request whose body was read whole, so that the next event is its end.
        work: what to run.
        seconds: how long it may take.

    Raises:
        ClientGone: the connection was closed.
        DeadlinePassed: ``seconds`` are over.
    """
    working = asyncio.ensure_future(work)
    leaving = asyncio.ensure_future(_disconnected(request))
    try:
        await asyncio.wait({working, leaving}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise ClientGone if leaving.done() else DeadlinePassed
    finally:
        for task in (working, leaving):
            task.cancel()
        await asyncio.gather(working, leaving, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
