# SPDX-License-Identifier: Apache-2.0
"""The preload of the service, with one body that no worker survives."""

import os
import time
from typing import Any

from pugeo_service.engine import worker as worker_module

POISON = b"POISON"

_run_stage = worker_module.run_stage


def run_stage(stage: Any, seconds: float, *args: Any) -> Any:
    """Run a stage; end the process at the poisonous body."""
    if stage.__name__ == "prepare" and args[0].tobytes().startswith(POISON):
        time.sleep(0.3)
        os._exit(9)
    return _run_stage(stage, seconds, *args)


def dask_setup(worker: object) -> None:
    """Warm the worker as the service does, then set the trap."""
    worker_module.dask_setup(worker)
    worker_module.run_stage = run_stage
