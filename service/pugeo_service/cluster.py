# SPDX-License-Identifier: Apache-2.0
"""The processes of a cluster beside the fronts: ``pugeo scheduler`` and ``pugeo worker``."""

import asyncio
import signal
import sys
import threading
from collections.abc import Awaitable, Callable
from types import FrameType
from typing import Any

import structlog

from pugeo_service.engine.children import end_at_once
from pugeo_service.engine.scheduler_host import run_scheduler
from pugeo_service.engine.worker_host import WorkerHost
from pugeo_service.preflight import unusable_host
from pugeo_service.settings import Settings
from pugeo_service.startup import begin, read_settings

__all__ = ["scheduler_main", "worker_main"]

_log = structlog.stdlib.get_logger("pugeo.service")
# Seconds after a signal in which the process must have ended, whatever hangs.
_END_S = 60.0


def scheduler_main(given: dict[str, Any]) -> int:
    """Schedule for fronts and workers until a signal; return the exit status.

    Args:
        given: settings over those of the environment; ``scheduler`` is the address to listen on.

    Returns:
        0 after a clean end, 1 if it cannot listen, 2 for a wrong setting.
    """
    settings = read_settings(given)
    if settings is None:
        return 2
    assert settings.scheduler is not None
    host = settings.scheduler.removeprefix("tls://").rpartition(":")[0].strip("[]")
    if _refused(unusable_host(host, "--host")) or not begin(settings, computes=False):
        return 2
    return _until_signal(lambda stop: run_scheduler(settings, stop))


def worker_main(given: dict[str, Any], host: str | None, port: int | None) -> int:
    """Work for a scheduler until a signal; return the exit status.

    Returns:
        0 after a clean end, 1 if no worker can start, 2 for a wrong setting.
    """
    settings = read_settings(given)
    if settings is None:
        return 2
    if settings.scheduler is None:
        sys.stderr.write("PUGEO_SCHEDULER: must be tls://host:port of a `pugeo scheduler`\n")
        return 2
    if host is not None and _refused(unusable_host(host, "--host")):
        return 2
    if not begin(settings):
        return 2
    _log.info("starting workers", scheduler=settings.scheduler, workers=settings.worker_count)
    return _until_signal(lambda stop: _work(settings, host, port, stop))


def _refused(problem: str | None) -> bool:
    """Write a line about a wrong option, if there is one."""
    if problem is not None:
        sys.stderr.write(problem + "\n")
    return problem is not None


async def _work(settings: Settings, host: str | None, port: int | None, stop: asyncio.Event) -> int:
    return await WorkerHost(settings, host, port).run(stop)


def _until_signal(run: Callable[[asyncio.Event], Awaitable[int]]) -> int:
    """Run in an event loop of its own thread; SIGTERM and SIGINT set the event that it is given."""
    loop = asyncio.new_event_loop()
    stop = asyncio.Event()
    status: list[int] = []

    async def whole() -> None:
        status.append(await run(stop))

    def begin_loop() -> None:
        # Ctrl+C reaches the whole process group. Child processes inherit this mask, and end in
        # order.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(whole())

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if not ending.is_alive():
            ending.start()
        loop.call_soon_threadsafe(stop.set)

    ending = threading.Timer(_END_S, end_at_once)
    ending.daemon = True
    thread = threading.Thread(target=begin_loop, name="cluster")
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    thread.start()
    thread.join()
    ending.cancel()
    return status[0] if status else 1
