# SPDX-License-Identifier: Apache-2.0
"""Configuration of Dask, the same for the embedded cluster and one of several machines."""

import logging
from typing import Any

import dask
import distributed
from distributed import scheduler

from pugeo_service.settings import Settings

__all__ = ["CONFIG", "configure_dask", "mutual_tls", "scheduler_options", "worker_environment"]

CONFIG: dict[str, Any] = {
    # A task that ends two workers is regarded as the cause.
    "distributed.scheduler.allowed-failures": 1,
    # A body travels as an argument, so that Dask can repeat a lost step by itself.
    "distributed.admin.large-graph-warning-threshold": "10 GB",
    "distributed.worker.preload": ["pugeo_service.engine.worker"],
    "distributed.worker.multiprocessing-method": "spawn",
    # By default a worker that needs more than 15 s to come back is given up for good.
    "distributed.deploy.lost-worker-timeout": "365 days",
    # A machine that is cut off answers nothing and closes nothing: after so long it is lost. The
    # default of 30 s keeps those waiting that need a result from it.
    "distributed.comm.timeouts.tcp": "15s",
    "distributed.comm.timeouts.connect": "15s",
    # No side doors: the ports that Dask insists on opening answer nothing.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # The two threads of a worker share one arena of free memory.
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": "1",
    # Tasks of one kind are neither held back in the scheduler nor moved away from their inputs
    # because there are many of them.
    "distributed.scheduler.rootish-taskgroup-dependencies": 0,
    # Each connection would keep its last 1,000 messages below a megabyte, bodies and all.
    "distributed.admin.low-level-log-length": 10,
    # Nobody reads Dask's profiler.
    "distributed.worker.profile.enabled": False,
    # Dask watches its loops 50 times a second, the memory of workers 10 times, itself twice, in
    # each of its servers: a front without requests took 4.2 % of a core, and takes 1.8 % so.
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.memory.monitor-interval": "500ms",
}
# Processes are the unit of parallelism; threads in each would fight over the same cores.
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class _NoSpans:
    """Replaces Dask's record of all work, which grows with each request and is never pruned."""

    def __init__(self, _scheduler: object) -> None: ...

    def __bool__(self) -> bool:
        return False

    def heartbeat(self, *_: object) -> None:
        """Ignore the reports of workers."""


def configure_dask() -> None:
    """Set the configuration of this process, which worker processes take over from their nanny."""
    dask.config.set(CONFIG)
    for name in ("distributed", "distributed.nanny", "distributed.scheduler"):
        logging.getLogger(name).setLevel(logging.WARNING)


def scheduler_options() -> dict[str, Any]:
    """Return the keyword arguments of each scheduler."""
    return {
        "dashboard": False,
        "extensions": {**scheduler.DEFAULT_EXTENSIONS, "spans": _NoSpans},
    }


def worker_environment(model: str) -> dict[str, str]:
    """Return the environment of worker processes that warm up with some weights."""
    return {**_ONE_THREAD, "PUGEO_MODEL": model}


def mutual_tls(settings: Settings) -> Any:
    """Return the security of connections in which both ends show the certificate of the settings.

    Dask has a certificate for each role; here one serves for all.
    """
    certificate, key = str(settings.tls_cert), str(settings.tls_key)
    roles = ("client", "scheduler", "worker")
    security: Any = distributed.Security
    return security(
        require_encryption=True,
        tls_ca_file=str(settings.tls_ca),
        **{f"tls_{role}_cert": certificate for role in roles},
        **{f"tls_{role}_key": key for role in roles},
    )
