# SPDX-License-Identifier: Apache-2.0
"""An event loop that runs between tests, for the engine that the tests of a file share."""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import pytest


@pytest.fixture(scope="module")
def in_background() -> Iterator[Callable[[Coroutine[Any, Any, None]], None]]:
    """Runs a coroutine in an event loop of its own thread and waits for its end.

    The loop never pauses: workers that hear nothing of their scheduler would end themselves.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        yield lambda task: asyncio.run_coroutine_threadsafe(task, loop).result()
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
