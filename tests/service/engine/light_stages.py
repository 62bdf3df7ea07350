# SPDX-License-Identifier: Apache-2.0
"""Stages and a preload for workers of tests, without the model."""

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
    """Add numbers as a quick stage."""
    return left + right


def has_weights(sha256: str) -> bool:
    """Tell whether a front has sent weights to this worker."""
    from pugeo_service.engine import model_store

    return sha256 in model_store._sent


def refuse() -> None:
    """Raise the error of a bad input."""
    from pugeo_model.errors import MalformedFileError

    raise MalformedFileError("cut short", code="truncated", expected=7)


def log(path: str, name: str) -> str:
    """Append a name to a file and return it."""
    with Path(path).open("a") as file:
        file.write(f"{name}\n")
    return name


def hold(gate: str, path: str, name: str) -> str:
    """Log a name, then wait until the file ``gate`` exists."""
    log(path, name)
    while not Path(gate).exists():
        time.sleep(0.01)
    return name


@quick
def open_gate(gate: str) -> None:
    """Make the file ``gate``, beside a stage that computes."""
    Path(gate).touch()


def nap(seconds: float, path: str, name: str) -> str:
    """Log a name, then sleep."""
    log(path, name)
    time.sleep(seconds)
    return name


def die(seconds: float) -> None:
    """End the process, as too little memory would."""
    time.sleep(seconds)
    os._exit(9)


def pid() -> int:
    """Return the id of the worker process."""
    return os.getpid()


def dask_setup(worker: object) -> None:
    """Prepare the worker without loading the model."""
    worker_module.one_at_a_time(worker)
