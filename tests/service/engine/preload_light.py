# SPDX-License-Identifier: Apache-2.0
"""A preload for workers of tests: no model, and stages that misbehave on demand."""

import os
import time
from pathlib import Path
from typing import Any

from pugeo_service.engine import stages
from pugeo_service.engine import worker as preload


def add(left: int, right: Any) -> int:
    """Add numbers; the second may be a list."""
    return left + (sum(right) if isinstance(right, list) else right)


def refuse() -> None:
    """Raise what a bad input raises."""
    from pugeo_model.errors import MalformedFileError

    raise MalformedFileError("cut short", code="truncated", expected=7)


def nap(seconds: float, path: str, name: str) -> str:
    """Sleep, and note when that began."""
    with Path(path).open("a") as file:
        file.write(f"{name}\n")
    time.sleep(seconds)
    return name


def die(seconds: float) -> None:
    """End the process, as a lack of memory would."""
    time.sleep(seconds)
    os._exit(9)


def pid() -> int:
    """Tell who works."""
    return os.getpid()


def dask_setup(worker: object) -> None:
    """Give the worker the stages above."""
    preload.one_at_a_time(worker)
    for stage in (add, refuse, nap, die, pid):
        setattr(stages, stage.__name__, stage)
    # In the place of a quick one.
    stages.chunk = add  # type: ignore[assignment]
