# SPDX-License-Identifier: Apache-2.0
"""Tasks of light stages on a backend, and waiting for their effects."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from tests.service.engine import light_stages as light

from pugeo_service.engine.dask_backend import DaskBackend


def submit(
    backend: DaskBackend,
    stage: Any,
    *args: Any,
    priority: float = 0,
    seconds: float = 60,
    patches: int = 0,
) -> Any:
    """Submit with defaults."""
    return backend.submit(
        stage, *args, priority=priority, seconds=seconds, long=False, patches=patches
    )


def known(backend: DaskBackend, handles: list[Any]) -> int:
    """Number of these tasks that the scheduler has."""
    tasks = backend._cluster.scheduler.tasks
    return sum(handle.key in tasks for handle in handles)


async def until_quick(backend: DaskBackend) -> None:
    """Wait until quick stages run beside another: a new worker has one thread at first."""
    handles: list[Any] = []

    def check() -> bool:
        handles.append(submit(backend, light.add_quickly, 1, 1))
        return any(handle.done() for handle in handles)

    await until(check)


async def warm(backend: DaskBackend, count: int) -> None:
    """Wait until there are so many workers."""
    await until(lambda: backend.warm_workers == count)


async def until(check: Callable[[], bool], seconds: float = 100.0) -> None:
    """Wait until a condition holds."""
    for _ in range(int(seconds / 0.05)):
        if check():
            return
        await asyncio.sleep(0.05)
    pytest.fail(f"not true after {seconds:g} s")
