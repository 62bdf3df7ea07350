# SPDX-License-Identifier: Apache-2.0
"""Stages and a preload for workers of tests: no model, and stages that misbehave on demand."""

import os
import time
from pathlib import Path
from typing import Any

from pugeo_service.engine import worker as worker_module
from pugeo_service.engine.backend import quick


def add(left: int, right: Any) -> int:
    """Add numbers; the second may be a list."""
    return left + (sum(right) if isinstance(right, list) else right)


@quick
def add_quickly(left: int, right: int) -> int:
    """Add numbers beside a stage that computes."""
    return left + right


def refuse() -> None:
    """Raise the error of a bad input."""
    from pugeo_model.errors import MalformedFileError

    raise MalformedFileError("cut short", code="truncated", expected=7)


def nap(seconds: float, path: str, name: str) -> str:
    """Sleep, and note the begin."""
    with Path(path).open("a") as file:
        file.write(f"{name}\n")
    time.sleep(seconds)
    return name


def die(seconds: float) -> None:
    """End the process, as a lack of memory would."""
    time.sleep(seconds)
    os._exit(9)


def pid() -> int:
    """Return the number of the worker's process."""
    return os.getpid()


def dask_setup(worker: object) -> None:
    """Prepare the worker without loading the model."""
    worker_module.one_at_a_time(worker)
