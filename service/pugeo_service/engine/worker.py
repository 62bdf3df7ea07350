# SPDX-License-Identifier: Apache-2.0
"""What every worker does before its first task: ``dask worker --preload`` names this module.

Dask runs a preload before the worker tells the scheduler that it exists, so every worker that
the scheduler knows is warm.
"""

import logging
import os
import signal
import sys
from typing import Any

from distributed import Status
from distributed.threadpoolexecutor import ThreadPoolExecutor
from tornado.ioloop import PeriodicCallback

from pugeo_model.malloc import give_back_freed_memory
from pugeo_service.engine import stages
from pugeo_service.engine.backend import CORE
from pugeo_service.engine.sample import sample_body, sample_order

__all__ = ["dask_setup", "one_at_a_time", "warm"]

_TIDY_MS = 5_000
_LOOK_MS = 50
_SWITCH_S = 5e-4


def warm(model: str) -> None:
    """Load the model and send a small sphere all the way, so that no user waits for it."""
    prepared = stages.prepare(sample_body(), sample_order(model, deadline_s=0.0))
    total = stages.describe_prepared(prepared).patches
    charted = [stages.predict_part(prepared, i, i + 1, model) for i in range(total)]
    stages.finish(prepared, charted, model, "ply")


def one_at_a_time(worker: Any) -> None:
    """Give a worker the one core that stages which work need, and a second thread for the others.

    The scheduler is told of one thread: it would take two for twice the memory, and a worker that
    works for one with a thread to spare.
    """
    worker.state.total_resources[CORE] = worker.state.available_resources[CORE] = 1
    worker.executors["default"] = ThreadPoolExecutor(  # type: ignore[no-untyped-call]
        2, thread_name_prefix="pugeo"
    )

    def known() -> None:
        if worker.status == Status.running:
            worker.state.nthreads = 2
            waiting.stop()

    waiting = PeriodicCallback(known, _LOOK_MS)
    worker.periodic_callbacks["known"] = waiting


def dask_setup(worker: Any) -> None:
    """Warm this process; Dask calls it in every worker before the worker registers."""
    # Before anything can fail: tasks then fail as well, and tell why, instead of waiting for ever.
    one_at_a_time(worker)
    # Ctrl+C reaches the whole process group, and the front ends its workers in good order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Dask logs every exception with all arguments; the front logs those that are bugs.
    logging.getLogger("distributed.worker").setLevel(logging.ERROR)
    # What computes lets what carries in ten times as soon: 8 patches over two workers took 0.45 s
    # in the median, and 0.39 s so.
    sys.setswitchinterval(_SWITCH_S)
    warm(os.environ.get("PUGEO_MODEL", "standard"))
    # What other clouds left between the results that live here would add up.
    worker.periodic_callbacks["tidy"] = PeriodicCallback(give_back_freed_memory, _TIDY_MS)
