# SPDX-License-Identifier: Apache-2.0
"""The scheduler of a cluster of several machines, in a process of its own."""

import asyncio
import logging
import resource
import sys
from typing import Any

import dask
import structlog
from distributed.scheduler import Scheduler

from pugeo_service.engine.backend import QUICK_PREFIX
from pugeo_service.engine.dask_config import configure_dask, mutual_tls, scheduler_options
from pugeo_service.engine.worker_watch import WorkerWatch
from pugeo_service.settings import Settings

__all__ = ["VersionedScheduler", "run_scheduler"]

_log = structlog.stdlib.get_logger("pugeo.scheduler")
_CLOSE_S = 10.0


class VersionedScheduler(Scheduler):
    """Dask's scheduler, changed to keep the resources of a task after its worker is lost.

    A task may name a worker and allow others. Once that worker is lost, Dask drops the task's
    resources too, which select workers of the same version of pugeo.
    """

    def valid_workers(self, ts: Any) -> Any:
        """Return the workers that may run a task; ``None`` for all."""
        found = super().valid_workers(ts)
        if found or not ts.loose_restrictions or not ts.resource_restrictions:
            return found
        ts.worker_restrictions, ts.loose_restrictions = set(), False
        return super().valid_workers(ts)

    def _task_to_msg(self, ts: Any) -> dict[str, Any]:
        """Return the message that gives a task to a worker.

        The resource of quick stages only chooses the worker. There a task with a resource would
        wait behind those that wait for the core.
        """
        message = super()._task_to_msg(ts)
        if ts.resource_restrictions:
            message["resource_restrictions"] = {
                name: amount
                for name, amount in ts.resource_restrictions.items()
                if not name.startswith(QUICK_PREFIX)
            }
        return message


async def run_scheduler(settings: Settings, stop: asyncio.Event) -> int:
    """Schedule tasks until ``stop`` is set; return the exit status.

    Args:
        settings: ``scheduler`` is the address to listen on; port 0 takes a free one.
        stop: set by a signal.
    """
    configure_dask()
    # `WorkerWatch` looks instead.
    dask.config.set({"distributed.scheduler.worker-ttl": None})
    # A probe that connects and leaves would be a line each time; whoever has a wrong certificate
    # says so itself.
    logging.getLogger("distributed.comm.tcp").setLevel(logging.ERROR)
    _allow_descriptors()
    try:
        scheduler = await VersionedScheduler(
            host=settings.scheduler,
            security=mutual_tls(settings),
            dashboard_address="127.0.0.1:0",
            **scheduler_options(),
        )
    except (OSError, RuntimeError) as error:
        reason = str(error.__cause__ or error)
        _log.error("cannot listen", address=settings.scheduler, reason=reason)
        return 1
    sys.stdout.write(f"pugeo schedules {scheduler.address}\n")
    sys.stdout.flush()
    watching = asyncio.create_task(WorkerWatch(scheduler).run())
    await stop.wait()
    watching.cancel()
    # Workers and fronts stay, and come back to the next scheduler of this address.
    await asyncio.wait({asyncio.create_task(scheduler.close(reason="signal"))}, timeout=_CLOSE_S)
    return 0


def _allow_descriptors() -> None:
    """Allow as many open connections as the system does: each worker and front needs some."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
