# SPDX-License-Identifier: Apache-2.0
"""The one function that the scheduler is ever sent."""

import faulthandler
from typing import Any

from pugeo_service.engine.backend import QUICK

__all__ = ["run_stage"]

# Room for the answer to cross before the clock of the front strikes first.
_GRACE_S = 5.0


def run_stage(stage: str, seconds: float, *args: Any) -> Any:
    """Run a function of ``stages``; end this process if one that works takes over ``seconds``.

    A task cannot be interrupted from outside, and one that hangs would hold its worker for
    ever. The process ends itself instead and is replaced. The clock is faulthandler's own
    thread, which needs no interpreter lock and leaves a traceback in the log. A process has one
    such clock, which is that of the stage that works; those that run beside it leave it alone.
    """
    # Here and not above: the front sends this function and must not load what stages need.
    from pugeo_service.engine import stages

    run = getattr(stages, stage)
    if stage in QUICK:
        return run(*args)
    faulthandler.dump_traceback_later(max(1.0, seconds) + _GRACE_S, exit=True)
    try:
        return run(*args)
    finally:
        faulthandler.cancel_dump_traceback_later()
