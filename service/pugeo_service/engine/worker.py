# SPDX-License-Identifier: Apache-2.0
"""The worker process: its preload (named in `dask_config`) and its tasks.

Dask runs a preload before the worker tells the scheduler that it exists, so every worker that
the scheduler knows is warm.
"""

import faulthandler
import logging
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from distributed import Status
from distributed.threadpoolexecutor import ThreadPoolExecutor
from tornado.ioloop import PeriodicCallback

from pugeo_model.errors import BadOptionError
from pugeo_model.malloc import give_back_freed_memory
from pugeo_model.weights import read_card
from pugeo_service import __version__
from pugeo_service.engine import stages
from pugeo_service.engine.backend import CORE, QUICK, is_quick
from pugeo_service.engine.messages import ModelId
from pugeo_service.engine.self_test import self_test_body, self_test_request

__all__ = ["VERSION_METRIC", "dask_setup", "one_at_a_time", "run_stage", "warm"]

T = TypeVar("T")

# Room for the answer to arrive before the front's own deadline.
_GRACE_S = 5.0
_TIDY_MS = 5_000
_LOOK_MS = 50
_SWITCH_S = 5e-4
_RELEASED = "standard"
_PLENTY = 1_000_000

VERSION_METRIC = "pugeo_version"
"""Name under which a worker reports its version."""


def run_stage(stage: Callable[..., T], seconds: float, *args: Any) -> T:
    """Run a stage; end this process if one that computes takes over ``seconds``.

    A task cannot be interrupted from outside, and one that hangs would hold its worker for ever.
    The process ends itself instead and is replaced. The timer is faulthandler's own thread, which
    needs no interpreter lock and leaves a traceback in the log. A process has one such timer; it
    belongs to the stage that computes, and quick stages leave it alone.
    """
    if is_quick(stage):
        return stage(*args)
    faulthandler.dump_traceback_later(max(1.0, seconds) + _GRACE_S, exit=True)
    try:
        return stage(*args)
    finally:
        faulthandler.cancel_dump_traceback_later()


def warm(name: str) -> None:
    """Load a model and upsample a small sphere, so that no user waits for it.

    Args:
        name: of the model, or path of its weights; if they are not here, the front sends them, and
            those of the package serve as well.
    """
    try:
        sha256 = read_card(name)["sha256"]
    except BadOptionError:
        name, sha256 = _RELEASED, read_card(_RELEASED)["sha256"]
    request = self_test_request(ModelId(name, sha256), deadline_s=0.0)
    # In one task, however many patches the network takes for it.
    prepared = stages.prepare(self_test_body(), replace(request, one_task_patches=sys.maxsize))
    assert prepared.output is not None


def one_at_a_time(worker: Any) -> None:
    """Give a worker one core for the stages that compute, and a second thread for quick ones.

    The scheduler is told of one thread: of two it would infer twice the memory, and that a worker
    that computes has a thread to spare.
    """
    for name, amount in ((CORE, 1), (QUICK, _PLENTY)):
        worker.state.total_resources[name] = worker.state.available_resources[name] = amount
    # For the log of fronts that do not use this worker.
    worker.metrics[VERSION_METRIC] = lambda _worker: __version__
    worker.executors["default"] = ThreadPoolExecutor(  # type: ignore[no-untyped-call]
        2, thread_name_prefix="pugeo"
    )

    def add_thread() -> None:
        if worker.status == Status.running:
            worker.state.nthreads = 2
            waiting.stop()

    waiting = PeriodicCallback(add_thread, _LOOK_MS)
    worker.periodic_callbacks["add_thread"] = waiting


def _in_one_line(record: logging.LogRecord) -> bool:
    """Replace a traceback of Dask by its error: it tells of connections that others have closed."""
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        record.msg = f"{record.getMessage()} ({type(error).__name__}: {error})"
        record.args, record.exc_info, record.exc_text = (), None, None
    return True


def dask_setup(worker: Any) -> None:
    """Warm this process; Dask calls it in every worker before the worker registers."""
    # First, since it cannot fail: if anything below fails, tasks fail too and say why.
    one_at_a_time(worker)
    # Ctrl+C reaches the whole process group; the front stops its workers in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Dask logs every exception with all arguments; the front logs the ones that are bugs.
    logging.getLogger("distributed.worker").setLevel(logging.CRITICAL)
    for handler in logging.getLogger("distributed").handlers:
        handler.addFilter(_in_one_line)
    # The thread that computes yields to the one that transfers ten times as often: 8 patches over
    # two workers take 0.39 s in the median instead of 0.45 s.
    sys.setswitchinterval(_SWITCH_S)
    warm(os.environ.get("PUGEO_MODEL", _RELEASED))
    # Memory that other clouds left free between surviving results would add up.
    worker.periodic_callbacks["tidy"] = PeriodicCallback(give_back_freed_memory, _TIDY_MS)
